//! Computes figures of the quality of a map.

use super::basis::transposed_product;
use super::samples::Samples;

/// The quality of a map, as it is stored with the map.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Quality {
    /// Mass-weighted mean squared descriptor difference between matched vertices; 0 is perfect.
    pub descriptor_residual: f64,
    /// `‖CᵀC − I‖_F / √k`; 0 for an isometry.
    pub orthogonality: f64,
    /// Share of the mass of shape 1 that is matched, 0 to 1.
    pub coverage: f64,
    /// Share of entries of C with magnitude below 0.1 (Yang and Tian report at least 0.9).
    pub near_zero: f64,
    /// For part maps: mass-weighted mean squared descriptor difference between a vertex of shape 2
    /// and the match of its match; 0 is perfect.
    pub descriptor_return: f64,
    /// For part maps: share of the area on which a transferred label is expected to be right.
    pub confidence: f64,
    /// Share of the mass of shape 2 that has a counterpart.
    pub matched: f64,
}

/// Further figures of the map and the two shapes, without ground truth.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Assessment {
    /// Mean distance, in units of the square root of the area, between a sample of shape 1 and its
    /// image after mapping it to shape 2 and back.
    pub round_trip: f64,
    /// Dirichlet energy of the coordinates of shape 1 transferred to shape 2, over that of shape
    /// 2's own coordinates: near 1 for a smooth map, large for a torn one.
    pub smoothness: f64,
}

impl Quality {
    /// The quality of a map `c_12 (k2, k1)` and its pointwise map `p2p_21 (n2,)`, with the mass
    /// `(n1,)` of shape 1; figures that need descriptors stay 0.
    ///
    /// ```
    /// use coseg_geometry::fmap::Quality;
    ///
    /// // The identity on four vertices, and a map that takes all of them to one.
    /// let (mass, identity) = ([0.25; 4], [1.0, 0.0, 0.0, 1.0]);
    /// let good = Quality::of_map(&mass, &identity, 2, &[0, 1, 2, 3]);
    /// assert_eq!((good.orthogonality, good.coverage), (0.0, 1.0));
    /// let collapsed = Quality::of_map(&mass, &[1.0, 0.0, 0.0, 0.0], 2, &[3, 3, 3, 3]);
    /// assert_eq!((collapsed.orthogonality, collapsed.coverage), (0.5f64.sqrt(), 0.25));
    /// ```
    ///
    /// # Panics
    /// If the map names a vertex that does not exist.
    pub fn of_map(mass_1: &[f32], c_12: &[f32], k1: usize, p2p_21: &[u32]) -> Self {
        let k2 = c_12.len() / k1.max(1);
        let gram = transposed_product(c_12, c_12, k2, k1, k1);
        let entries = gram.iter().enumerate();
        let departure: f64 = entries
            .map(|(i, g)| f64::from(g - if i / k1 == i % k1 { 1.0 } else { 0.0 }).powi(2))
            .sum();
        let small = c_12.iter().filter(|x| x.abs() < 0.1).count();
        let mut hit = vec![false; mass_1.len()];
        for t in p2p_21 {
            hit[*t as usize] = true;
        }
        let (mut covered, mut total) = (0.0, 0.0);
        for (hit, mass) in hit.iter().zip(mass_1) {
            total += f64::from(*mass);
            covered += if *hit { f64::from(*mass) } else { 0.0 };
        }
        Self {
            orthogonality: (departure / k1.max(1) as f64).sqrt(),
            coverage: covered / f64::max(total, 1e-300),
            near_zero: small as f64 / c_12.len().max(1) as f64,
            matched: 1.0,
            ..Self::default()
        }
    }
}

impl Assessment {
    /// Assesses a map between shapes of area 1. `p2p_21` and `p2p_12` are the maps between their
    /// samples in both directions; `dense_21 (n2,)` maps all vertices of shape 2.
    ///
    /// ```
    /// use coseg_geometry::fmap::{Assessment, samples::farthest_point_samples};
    /// use coseg_geometry::mesh::{EdgeGraph, icosphere};
    ///
    /// let sphere = icosphere(1);
    /// let graph = EdgeGraph::new(&sphere, &[]);
    /// let samples = farthest_point_samples(&graph, &[1.0 / 42.0; 42], &[10]).remove(0);
    /// let vertices: Vec<[f32; 3]> = sphere.vertices.iter().map(|p| p.map(|x| x as f32)).collect();
    /// let all: Vec<u32> = (0..42).collect();
    /// let identity = (&all[..10], &all[..10]);
    /// let faces = &sphere.faces[..];
    /// let found = Assessment::new((&vertices, &samples), (&vertices, faces), identity, &all);
    /// assert_eq!((found.round_trip, found.smoothness), (0.0, 1.0));
    /// ```
    pub fn new(
        one: (&[[f32; 3]], &Samples),
        two: (&[[f32; 3]], &[[u32; 3]]),
        (p2p_21, p2p_12): (&[u32], &[u32]),
        dense_21: &[u32],
    ) -> Self {
        let returns = returned(one, (p2p_12, p2p_21));
        let weighted = returns.iter().zip(&one.1.mass);
        let sum: f64 = weighted.map(|(d, m)| f64::from(d * m)).sum();
        let total: f64 = one.1.mass.iter().map(|m| f64::from(*m)).sum();
        let transferred = |v: u32| one.0[dense_21[v as usize] as usize];
        let own = dirichlet(two.1, two.0, |v| two.0[v as usize]);
        Self {
            round_trip: sum / total.max(1e-300),
            smoothness: dirichlet(two.1, two.0, transferred) / own.max(1e-300),
        }
    }
}

/// The distance of each sample of a shape from its image under the maps between samples there and
/// back.
pub(super) fn returned(
    (vertices, samples): (&[[f32; 3]], &Samples),
    (there, back): (&[u32], &[u32]),
) -> Vec<f32> {
    let at = |s: u32| vertices[samples.vertices[s as usize] as usize];
    let ways = there.iter().enumerate();
    ways.map(|(s, t)| {
        let (a, b) = (at(s as u32), at(back[*t as usize]));
        (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f32>().sqrt()
    })
    .collect()
}

/// Dirichlet energy of three functions on a mesh; triangles without area are omitted.
fn dirichlet(faces: &[[u32; 3]], vertices: &[[f32; 3]], value: impl Fn(u32) -> [f32; 3]) -> f64 {
    let difference =
        |a: [f32; 3], b: [f32; 3]| -> [f64; 3] { std::array::from_fn(|i| f64::from(a[i] - b[i])) };
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let mut energy = 0.0;
    for face in faces {
        let p = face.map(|v| vertices[v as usize]);
        let f = face.map(&value);
        let (u, w) = (difference(p[1], p[0]), difference(p[2], p[0]));
        let doubled = (dot(u, u) * dot(w, w) - dot(u, w).powi(2)).max(0.0).sqrt();
        if doubled < 1e-12 {
            continue;
        }
        for i in 0..3 {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            let (a, b) = (difference(p[j], p[i]), difference(p[k], p[i]));
            let d = difference(f[k], f[j]);
            energy += 0.5 * dot(a, b) / doubled * dot(d, d);
        }
    }
    energy
}

#[cfg(test)]
mod tests {
    use super::super::convert::functional;
    use super::super::test_shapes::cycle;
    use super::{Quality, dirichlet};

    #[test]
    fn an_isometry_is_perfect_and_a_collapse_is_not() {
        let (a, b) = (cycle(100, 0), cycle(100, 9));
        let turned: Vec<u32> = (0..100).map(|v| (v + 9) % 100).collect();
        let c = functional(&a.basis(), &b.basis(), &turned, 11, 11);
        let good = Quality::of_map(&a.mass, &c, 11, &turned);
        assert!(good.orthogonality < 1e-3 && (good.coverage - 1.0).abs() < 1e-5);
        let collapsed = vec![5; 100];
        let c = functional(&a.basis(), &b.basis(), &collapsed, 11, 11);
        let bad = Quality::of_map(&a.mass, &c, 11, &collapsed);
        assert!(bad.orthogonality > 0.9 && bad.coverage < 0.011);
    }

    #[test]
    fn the_energy_of_coordinates_is_twice_the_area() {
        let vertices = [
            [0.0, 0.0, 0.0],
            [2.0, 0.0, 0.0],
            [2.0, 1.0, 0.5],
            [0.0, 1.0, 0.5],
        ];
        let faces = [[0, 1, 2], [0, 2, 3]];
        let area = 2.0 * 1.25f64.sqrt();
        let energy = dirichlet(&faces, &vertices, |v| vertices[v as usize]);
        assert!((energy - 2.0 * area).abs() < 1e-5);
        assert_eq!(dirichlet(&faces, &vertices, |_| [1.0; 3]), 0.0);
    }
}
