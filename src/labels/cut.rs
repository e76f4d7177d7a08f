//! Per-face evidence becomes labels: a Potts energy on the dual graph, minimised by α-expansion
//! (Boykov, Veksler and Zabih 2001).

use crate::linalg::maxflow::Network;
use crate::segmentation::Surface;

/// Boundary strength for labelling shapes. Discovery uses a higher one.
pub const STRENGTH: f64 = 3.0;
/// Energies are rounded to multiples of 1 / `UNITS` nat, so that cuts are exact in integers.
const UNITS: f64 = 1e6;
/// Upper limit of the evidence against a label, in nats.
const CAP_NATS: f64 = 50.0;
const MAX_SWEEPS: usize = 4;

/// The integer energy: `unary (m, k)`, and a cost for each edge whose ends have different labels.
struct Energy<'a> {
    unary: Vec<i64>,
    k: usize,
    edges: Vec<(usize, usize, i64)>,
    fixed: Option<&'a [Option<u32>]>,
}

impl Energy<'_> {
    fn of(&self, labels: &[u32]) -> i64 {
        let faces: i64 = labels
            .iter()
            .enumerate()
            .map(|(f, l)| self.unary[f * self.k + *l as usize])
            .sum();
        let edges: i64 = self
            .edges
            .iter()
            .filter(|e| labels[e.0] != labels[e.1])
            .map(|e| e.2)
            .sum();
        faces + edges
    }

    /// Returns the best labelling in which each face either changes to `alpha` or keeps its label.
    fn expand(&self, labels: &[u32], alpha: u32) -> Vec<u32> {
        let mut network = Network::new(labels.len());
        // The cost of taking alpha, which is the sink side of the cut.
        let mut take: Vec<i64> = (0..labels.len())
            .map(|f| self.unary[f * self.k + alpha as usize])
            .collect();
        let mut keep: Vec<i64> = labels
            .iter()
            .enumerate()
            .map(|(f, l)| self.unary[f * self.k + *l as usize])
            .collect();
        if let Some(fixed) = self.fixed {
            let forbid = i64::MAX / 1_000_000_000;
            for (f, pin) in fixed.iter().enumerate() {
                if pin.is_some_and(|l| l != alpha) {
                    take[f] = keep[f] + forbid;
                }
            }
        }
        for &(p, q, w) in &self.edges {
            let both_keep = if labels[p] != labels[q] { w } else { 0 };
            let q_takes = if labels[p] != alpha { w } else { 0 };
            let p_takes = if labels[q] != alpha { w } else { 0 };
            // With x = 1 for taking alpha: both_keep + (p_takes − both_keep) x_p − p_takes x_q +
            // (q_takes + p_takes − both_keep) (1 − x_p) x_q. The negative term is added to the cost
            // of keeping.
            keep[p] += both_keep;
            take[p] += p_takes;
            keep[q] += p_takes;
            network.edge(p, q, q_takes + p_takes - both_keep, 0);
        }
        for f in 0..labels.len() {
            network.terminal(f, take[f], keep[f]);
        }
        network
            .sink_side()
            .into_iter()
            .zip(labels)
            .map(|(takes, l)| if takes { alpha } else { *l })
            .collect()
    }
}

/// Returns labels `(m,)` that locally minimise `Σ_f m a_f unary_f,l(f) + strength Σ_e
/// boundary_cost_e [l(e₀) ≠ l(e₁)]`. `unary (m, k)` is in nats (usually −ln p), `a` are area
/// shares, and `boundary_cost` is 1 for a flat edge of mean length.
///
/// No single α-expansion lowers the energy of the result. Faces with a label in `pinned` keep it.
pub fn cut(
    surface: &Surface,
    unary: &[f64],
    k: usize,
    strength: f64,
    pinned: Option<&[Option<u32>]>,
) -> Vec<u32> {
    let m = surface.n_faces();
    assert_eq!(unary.len(), m * k, "unary is m x k");
    let mut energy = Energy {
        unary: Vec::with_capacity(m * k),
        k,
        edges: surface
            .edges
            .iter()
            .map(|e| {
                let [p, q] = e.faces.map(|f| f as usize);
                (p, q, (strength * e.boundary_cost * UNITS).round() as i64)
            })
            .filter(|e| e.2 > 0)
            .collect(),
        fixed: pinned,
    };
    for (f, row) in unary.chunks_exact(k).enumerate() {
        let scale = surface.area[f] * m as f64 * UNITS;
        energy.unary.extend(
            row.iter()
                .map(|u| (u.clamp(0.0, CAP_NATS) * scale).round() as i64),
        );
    }
    let mut labels: Vec<u32> = unary
        .chunks_exact(k)
        .enumerate()
        .map(|(f, row)| {
            let least = (0..k)
                .min_by(|&a, &b| row[a].total_cmp(&row[b]))
                .unwrap_or(0) as u32;
            pinned.and_then(|p| p[f]).unwrap_or(least)
        })
        .collect();
    let mut least = energy.of(&labels);
    for _ in 0..MAX_SWEEPS {
        let mut lowered = false;
        for alpha in 0..k as u32 {
            let candidate = energy.expand(&labels, alpha);
            let value = energy.of(&candidate);
            if value < least {
                (least, labels, lowered) = (value, candidate, true);
            }
        }
        if !lowered {
            break;
        }
    }
    labels
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::segmentation::SurfaceEdge;
    use rand::{Rng, SeedableRng};

    fn random_surface(rng: &mut rand_pcg::Pcg64, m: usize) -> Surface {
        let mut edges = Vec::new();
        for _ in 0..2 * m {
            let faces = [rng.random_range(0..m as u32), rng.random_range(0..m as u32)];
            let boundary_cost = rng.random_range(0.0..1.5);
            if faces[0] != faces[1] {
                edges.push(SurfaceEdge {
                    faces,
                    length: 1.0,
                    crease: 0.0,
                    boundary_cost,
                });
            }
        }
        Surface {
            area: vec![1.0 / m as f64; m],
            centroids: vec![[0.0; 3]; m],
            edges,
        }
    }

    fn energy(s: &Surface, unary: &[f64], k: usize, labels: &[u32]) -> f64 {
        let faces: f64 = labels
            .iter()
            .enumerate()
            .map(|(f, l)| unary[f * k + *l as usize])
            .sum();
        let cut = |e: &&SurfaceEdge| labels[e.faces[0] as usize] != labels[e.faces[1] as usize];
        faces
            + s.edges
                .iter()
                .filter(cut)
                .map(|e| e.boundary_cost)
                .sum::<f64>()
    }

    #[test]
    fn two_labels_reach_the_global_minimum() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(5);
        for round in 0..200 {
            let m = rng.random_range(2..10usize);
            let s = random_surface(&mut rng, m);
            let unary: Vec<f64> = (0..2 * m).map(|_| rng.random_range(0.0..3.0)).collect();
            let found = energy(&s, &unary, 2, &cut(&s, &unary, 2, 1.0, None));
            let least = (0..1u32 << m)
                .map(|b| {
                    energy(
                        &s,
                        &unary,
                        2,
                        &(0..m).map(|f| b >> f & 1).collect::<Vec<_>>(),
                    )
                })
                .fold(f64::INFINITY, f64::min);
            assert!(
                found <= least + 1e-4,
                "round {round}: {found} against {least}"
            );
        }
    }

    #[test]
    fn no_expansion_lowers_the_energy_and_pins_hold() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(6);
        for round in 0..60 {
            let (m, k) = (rng.random_range(2..8usize), 3usize);
            let s = random_surface(&mut rng, m);
            let unary: Vec<f64> = (0..k * m).map(|_| rng.random_range(0.0..3.0)).collect();
            let labels = cut(&s, &unary, k, 1.0, None);
            let found = energy(&s, &unary, k, &labels);
            for alpha in 0..k as u32 {
                for subset in 0..1u32 << m {
                    let moved: Vec<u32> = (0..m)
                        .map(|f| {
                            if subset >> f & 1 == 1 {
                                alpha
                            } else {
                                labels[f]
                            }
                        })
                        .collect();
                    assert!(
                        energy(&s, &unary, k, &moved) >= found - 1e-4,
                        "round {round}"
                    );
                }
            }
            let pins: Vec<Option<u32>> = (0..m).map(|f| (f % 2 == 0).then_some(2)).collect();
            let pinned = cut(&s, &unary, k, 1.0, Some(&pins));
            assert!((0..m).step_by(2).all(|f| pinned[f] == 2));
        }
    }
}
