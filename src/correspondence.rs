//! Matches the parts of shape A with those of shape B by a pointwise map.

use crate::segmentation::Surface;

/// Connected pieces of equal label.
#[derive(Debug, Clone, PartialEq)]
pub struct Parts {
    /// Part of each face `(m,)`; parts are numbered by descending area.
    pub part_of_face: Vec<u32>,
    /// Label of each part.
    pub label: Vec<u32>,
    /// Area share of each part.
    pub area: Vec<f64>,
}

/// The parts of a labelled surface; bridges between components count as connections.
pub fn parts(surface: &Surface, labels: &[u32]) -> Parts {
    let m = surface.n_faces();
    let mut root: Vec<u32> = (0..m as u32).collect();
    fn find(root: &mut [u32], mut f: u32) -> u32 {
        while root[f as usize] != f {
            root[f as usize] = root[root[f as usize] as usize];
            f = root[f as usize];
        }
        f
    }
    for e in &surface.edges {
        let [a, b] = e.faces;
        if labels[a as usize] == labels[b as usize] {
            let (a, b) = (find(&mut root, a), find(&mut root, b));
            root[a.max(b) as usize] = a.min(b);
        }
    }
    let roots: Vec<u32> = (0..m as u32).map(|f| find(&mut root, f)).collect();
    let mut area = vec![0.0; m];
    for (f, r) in roots.iter().enumerate() {
        area[*r as usize] += surface.area[f];
    }
    let mut order: Vec<u32> = (0..m as u32).filter(|f| roots[*f as usize] == *f).collect();
    order.sort_by(|&a, &b| {
        area[b as usize]
            .total_cmp(&area[a as usize])
            .then(a.cmp(&b))
    });
    let mut number = vec![0u32; m];
    for (i, r) in order.iter().enumerate() {
        number[*r as usize] = i as u32;
    }
    Parts {
        part_of_face: roots.iter().map(|r| number[*r as usize]).collect(),
        label: order.iter().map(|r| labels[*r as usize]).collect(),
        area: order.iter().map(|r| area[*r as usize]).collect(),
    }
}

/// Part of each vertex: the part with most of the area around it; ties go to the larger part.
pub fn part_of_vertex(
    parts: &Parts,
    n_vertices: usize,
    faces: &[[u32; 3]],
    area: &[f64],
) -> Vec<u32> {
    let mut around: Vec<Vec<(u32, f64)>> = vec![Vec::new(); n_vertices];
    for (f, face) in faces.iter().enumerate() {
        let part = parts.part_of_face[f];
        for v in face {
            let list = &mut around[*v as usize];
            match list.iter_mut().find(|x| x.0 == part) {
                Some(x) => x.1 += area[f],
                None => list.push((part, area[f])),
            }
        }
    }
    let most = |list: Vec<(u32, f64)>| {
        list.into_iter()
            .max_by(|x, y| x.1.total_cmp(&y.1).then(y.0.cmp(&x.0)))
            .map_or(0, |x| x.0)
    };
    around.into_iter().map(most).collect()
}

/// Intersection over union, by mass on shape B, of every part of B with every part of A transferred
/// by `p2p (n_b,)`: for each vertex of B a vertex of A. Returns pairs that overlap: (part of A,
/// part of B, overlap), by descending overlap.
pub fn overlaps(
    part_of_a: &[u32],
    part_of_b: &[u32],
    p2p: &[u32],
    mass_b: &[f32],
) -> Vec<(u32, u32, f64)> {
    let n_a = part_of_a.iter().max().map_or(0, |p| *p as usize + 1);
    let n_b = part_of_b.iter().max().map_or(0, |p| *p as usize + 1);
    let mut joint = vec![0.0; n_a * n_b];
    let (mut carried, mut own) = (vec![0.0; n_a], vec![0.0; n_b]);
    for (v, t) in p2p.iter().enumerate() {
        let (a, b) = (part_of_a[*t as usize] as usize, part_of_b[v] as usize);
        let mass = f64::from(mass_b[v]);
        joint[a * n_b + b] += mass;
        carried[a] += mass;
        own[b] += mass;
    }
    let mut found = Vec::new();
    for a in 0..n_a {
        for b in 0..n_b {
            let both = joint[a * n_b + b];
            if both > 0.0 {
                found.push((a as u32, b as u32, both / (carried[a] + own[b] - both)));
            }
        }
    }
    found.sort_by(|x, y| y.2.total_cmp(&x.2).then((x.0, x.1).cmp(&(y.0, y.1))));
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::segmentation::SurfaceEdge;

    #[test]
    fn parts_are_connected_pieces_largest_first() {
        let edge = |a, b| SurfaceEdge {
            faces: [a, b],
            length: 1.0,
            crease: 0.0,
            boundary_cost: 1.0,
        };
        let surface = Surface {
            area: vec![0.1, 0.1, 0.5, 0.3],
            centroids: vec![[0.0; 3]; 4],
            edges: vec![edge(0, 1), edge(1, 2), edge(2, 3)],
        };
        let parts = parts(&surface, &[7, 7, 3, 7]);
        assert_eq!(parts.label, vec![3, 7, 7]);
        assert_eq!(parts.part_of_face, vec![2, 2, 0, 1]);
        assert_eq!(parts.area, vec![0.5, 0.3, 0.2]);
    }

    #[test]
    fn overlap_is_intersection_over_union() {
        // Each shape has two parts; one of four vertices is mapped to the wrong one.
        let found = overlaps(&[0, 0, 1, 1], &[0, 0, 1, 1], &[0, 1, 1, 3], &[0.25; 4]);
        assert_eq!(found, vec![(0, 0, 2.0 / 3.0), (1, 1, 0.5), (0, 1, 0.25)]);
    }
}
