//! Labels of the proxy become labels of the input mesh, with boundaries along creases of that mesh.
//!
//! Away from boundaries, a face takes the label of its proxy face. In a band around the boundaries,
//! about as wide as the proxy's triangles, a cut at full resolution decides.

use super::cut::{STRENGTH, cut};
use crate::segmentation::{Surface, SurfaceEdge};

/// Half width of the band, in mean edge lengths of the proxy.
const BAND_EDGES: f64 = 1.5;
/// Probabilities below this count as this.
const FLOOR: f64 = 0.02;
/// Up to this ratio of the mean edge lengths of proxy and surface, plus one, the boundary strength
/// stays as it was tuned. On finer surfaces evidence, which grows with area, would outweigh
/// boundaries, which grow with length, and labels would follow the proxy's triangles. The strength
/// therefore grows with the ratio, up to a limit beyond which cuts would take too long.
const TUNED_RATIO: f64 = 3.0;
const MAX_GAIN: f64 = 2.0;
/// On such surfaces the proxy does not show where a boundary runs within a triangle. Evidence has
/// its full weight only at this distance from the boundary, in mean edge lengths of the proxy.
const UNSURE_EDGES: f64 = 0.75;

/// Returns the class of each face `(m,)` of a full-resolution surface. `proxy_face` has the proxy
/// face of each face; `classes (p,)` and `probabilities (p, k)`, 0 to 255, are those of the proxy;
/// `proxy_edge` is the proxy's mean edge length in the units of the surface.
pub fn refine_boundary(
    surface: &Surface,
    proxy_face: &[u32],
    proxy_edge: f64,
    classes: &[u32],
    probabilities: &[u8],
    k: usize,
) -> Vec<u32> {
    let m = surface.n_faces();
    let mut labels: Vec<u32> = proxy_face.iter().map(|p| classes[*p as usize]).collect();
    let depth = band(surface, &labels, BAND_EDGES * proxy_edge);
    // The faces of the band, and the faces around them, which are pinned as border conditions.
    let mut local = vec![u32::MAX; m];
    let mut members: Vec<u32> = Vec::new();
    let mut include = |f: u32, members: &mut Vec<u32>| {
        if local[f as usize] == u32::MAX {
            local[f as usize] = members.len() as u32;
            members.push(f);
        }
    };
    for e in &surface.edges {
        if e.faces.iter().any(|f| depth[*f as usize].is_finite()) {
            e.faces.iter().for_each(|f| include(*f, &mut members));
        }
    }
    if members.is_empty() {
        return labels;
    }
    let edges = surface
        .edges
        .iter()
        .filter(|e| e.faces.iter().any(|f| depth[*f as usize].is_finite()))
        .map(|e| SurfaceEdge {
            faces: e.faces.map(|f| local[f as usize]),
            ..*e
        })
        .collect();
    let total: f64 = members.iter().map(|f| surface.area[*f as usize]).sum();
    let sub = Surface {
        area: members
            .iter()
            .map(|f| surface.area[*f as usize] / total.max(1e-300))
            .collect(),
        centroids: Vec::new(),
        edges,
    };
    let lengths: f64 = surface.edges.iter().map(|e| e.length).sum();
    let ratio = proxy_edge * surface.edges.len() as f64 / lengths.max(1e-300);
    let gain = (ratio - TUNED_RATIO).clamp(1.0, MAX_GAIN);
    let unsure = (gain - 1.0).min(1.0);
    let mut unary = Vec::with_capacity(members.len() * k);
    let mut pinned = Vec::with_capacity(members.len());
    for &f in &members {
        let p = proxy_face[f as usize] as usize;
        let near = 1.0 - (depth[f as usize] / (UNSURE_EDGES * proxy_edge)).min(1.0);
        let weight = 1.0 - unsure * near;
        unary.extend((0..k).map(|l| {
            let probability = f64::from(probabilities[p * k + l]) / 255.0;
            -probability.max(FLOOR).ln() * weight
        }));
        pinned.push((!depth[f as usize].is_finite()).then_some(labels[f as usize]));
    }
    let refined = cut(&sub, &unary, k, gain * STRENGTH, Some(&pinned));
    for (f, l) in members.into_iter().zip(refined) {
        labels[f as usize] = l;
    }
    labels
}

/// Returns the distance of each face from the nearest label boundary along the dual graph; infinite
/// beyond `width`.
fn band(surface: &Surface, labels: &[u32], width: f64) -> Vec<f64> {
    let m = surface.n_faces();
    let mut neighbours: Vec<Vec<(u32, f64)>> = vec![Vec::new(); m];
    let mut depth = vec![f64::INFINITY; m];
    let mut front = Vec::new();
    for e in &surface.edges {
        let [a, b] = e.faces;
        let (p, q) = (surface.centroids[a as usize], surface.centroids[b as usize]);
        let step = (0..3).map(|c| (p[c] - q[c]).powi(2)).sum::<f64>().sqrt();
        neighbours[a as usize].push((b, step));
        neighbours[b as usize].push((a, step));
        if labels[a as usize] != labels[b as usize] {
            for f in [a, b] {
                if depth[f as usize] > 0.0 {
                    depth[f as usize] = 0.0;
                    front.push(f);
                }
            }
        }
    }
    // Label-correcting search: the band is a few rings wide, so a queue needs no priorities.
    while !front.is_empty() {
        let mut next = Vec::new();
        for f in front {
            for &(g, step) in &neighbours[f as usize] {
                let d = depth[f as usize] + step;
                if d <= width && d < depth[g as usize] {
                    depth[g as usize] = d;
                    next.push(g);
                }
            }
        }
        front = next;
    }
    depth
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Builds a strip of `n` faces with a concave crease between faces `crease` and `crease + 1`.
    fn strip(n: u32, crease: u32) -> Surface {
        let edge = |a: u32| SurfaceEdge {
            faces: [a, a + 1],
            length: 1.0,
            crease: if a == crease { 0.9 } else { 0.0 },
            boundary_cost: if a == crease { 0.02 } else { 1.0 },
        };
        Surface {
            area: vec![1.0 / f64::from(n); n as usize],
            centroids: (0..n).map(|f| [f64::from(f), 0.0, 0.0]).collect(),
            edges: (0..n - 1).map(edge).collect(),
        }
    }

    #[test]
    fn the_boundary_moves_to_the_crease_within_the_band() {
        let surface = strip(40, 17);
        let proxy_face: Vec<u32> = (0..40).map(|f| f / 5).collect();
        let classes: Vec<u32> = (0..8).map(|p| u32::from(p >= 4)).collect();
        let probabilities: Vec<u8> = classes
            .iter()
            .flat_map(|c| if *c == 0 { [150, 105] } else { [105, 150] })
            .collect();
        let refined = refine_boundary(&surface, &proxy_face, 3.0, &classes, &probabilities, 2);
        assert_eq!(refined.iter().position(|l| *l == 1), Some(18));
        let far = refine_boundary(&surface, &proxy_face, 0.5, &classes, &probabilities, 2);
        assert_eq!(
            far.iter().position(|l| *l == 1),
            Some(20),
            "the crease is outside the band"
        );
    }

    /// Builds a sheet of `n` by `n` squares whose proxy has a boundary of saw teeth, `tooth`
    /// squares wide, between two labels.
    fn saw(n: u32, tooth: u32) -> (Surface, Vec<u32>) {
        let mut edges = Vec::new();
        let mut join = |a: u32, b: u32| {
            edges.push(SurfaceEdge {
                faces: [a, b],
                length: 1.0,
                crease: 0.0,
                boundary_cost: 1.0,
            });
        };
        let mut proxy_face = Vec::new();
        for y in 0..n {
            for x in 0..n {
                let f = y * n + x;
                if x + 1 < n {
                    join(f, f + 1);
                }
                if y + 1 < n {
                    join(f, f + n);
                }
                let phase = x % (2 * tooth);
                let height = phase.min(2 * tooth - phase);
                proxy_face.push(u32::from(y >= n / 2 - tooth / 2 + height));
            }
        }
        let area = vec![1.0 / f64::from(n * n); (n * n) as usize];
        let centroids = (0..n * n)
            .map(|f| [f64::from(f % n), f64::from(f / n), 0.0])
            .collect();
        let surface = Surface {
            area,
            centroids,
            edges,
        };
        (surface, proxy_face)
    }

    #[test]
    fn the_teeth_of_coarse_triangles_do_not_show_on_a_fine_surface() {
        let (surface, proxy_face) = saw(120, 12);
        let probabilities = [230, 25, 25, 230];
        let refined = refine_boundary(&surface, &proxy_face, 12.0, &[0, 1], &probabilities, 2);
        let length = |labels: &[u32]| {
            let differ =
                |e: &&SurfaceEdge| labels[e.faces[0] as usize] != labels[e.faces[1] as usize];
            surface.edges.iter().filter(differ).count()
        };
        assert!(length(&proxy_face) > 220, "{}", length(&proxy_face));
        assert!(length(&refined) < 150, "{}", length(&refined));
    }
}
