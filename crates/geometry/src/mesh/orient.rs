//! Flips faces that disagree with their neighbours about which side is outside.
//!
//! Rays cast inward and the sign of a crease need the outside. Coherence spreads over edges with
//! two faces; of the two coherent orientations the one that flips fewer faces is taken. Then a
//! closed component with negative volume is flipped as a whole. A component within the box of
//! another closed one may be its cavity, whose outside is inward, and is only made coherent.

use super::adjacency::{EdgeFaces, ascends};
use super::{TriMesh, cross, dot, norm, sub};

/// Volumes below this fraction of area^1.5 are flat and have no inside. A sphere has 0.09.
const MIN_VOLUME: f64 = 1e-6;

struct Piece {
    faces: Vec<u32>,
    closed: bool,
    volume: f64,
    low: [f64; 3],
    high: [f64; 3],
}

/// Flips faces in place and returns their number.
pub(super) fn orient(mesh: &mut TriMesh, edges: &EdgeFaces) -> usize {
    let n = mesh.faces.len();
    let mut edges_of = vec![[0_u32; 3]; n];
    for e in 0..edges.edges.len() {
        for &(f, corner) in edges.around(e) {
            edges_of[f as usize][corner as usize] = e as u32;
        }
    }
    let mut turned: Vec<Option<bool>> = vec![None; n];
    let mut pieces = Vec::new();
    for start in 0..n {
        if turned[start].is_some() {
            continue;
        }
        turned[start] = Some(false);
        let mut faces = vec![start as u32];
        let mut closed = true;
        let mut next = 0;
        while let Some(&f) = faces.get(next) {
            next += 1;
            for e in edges_of[f as usize] {
                let &[(a, a_corner), (b, b_corner)] = edges.around(e as usize) else {
                    closed = false;
                    continue;
                };
                let coherent = ascends(mesh.faces[a as usize], a_corner)
                    != ascends(mesh.faces[b as usize], b_corner);
                let g = if a == f { b } else { a };
                let wanted = turned[f as usize] == Some(coherent);
                match turned[g as usize] {
                    None => {
                        turned[g as usize] = Some(wanted);
                        faces.push(g);
                    }
                    // One-sided surfaces have no outside.
                    Some(have) => closed &= have == wanted,
                }
            }
        }
        pieces.push(piece(mesh, &mut turned, faces, closed));
    }
    for i in 0..pieces.len() {
        let p = &pieces[i];
        let inside = |q: &Piece| {
            q.closed
                && (0..3).all(|k| q.low[k] <= p.low[k] && p.high[k] <= q.high[k])
                && q.volume.abs() > p.volume.abs()
        };
        if p.closed && p.volume < 0.0 && !pieces.iter().any(inside) {
            for &f in &p.faces {
                turned[f as usize] = turned[f as usize].map(|t| !t);
            }
        }
    }
    let mut count = 0;
    for (face, turned) in mesh.faces.iter_mut().zip(turned) {
        if turned == Some(true) {
            face.swap(1, 2);
            count += 1;
        }
    }
    count
}

fn piece(mesh: &TriMesh, turned: &mut [Option<bool>], faces: Vec<u32>, closed: bool) -> Piece {
    let n_turned = faces
        .iter()
        .filter(|&&f| turned[f as usize] == Some(true))
        .count();
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    let (mut volume, mut area) = (0.0, 0.0);
    let origin = mesh.corners(faces[0] as usize)[0];
    for &f in &faces {
        let state = &mut turned[f as usize];
        if 2 * n_turned > faces.len() {
            *state = state.map(|t| !t);
        }
        let corners = mesh.corners(f as usize);
        for p in corners {
            low = std::array::from_fn(|k| low[k].min(p[k]));
            high = std::array::from_fn(|k| high[k].max(p[k]));
        }
        let [a, b, c] = corners.map(|p| sub(p, origin));
        let sign = if *state == Some(true) { -1.0 } else { 1.0 };
        volume += sign * dot(a, cross(b, c)) / 6.0;
        area += 0.5 * norm(cross(sub(b, a), sub(c, a)));
    }
    let closed = closed && volume.abs() > MIN_VOLUME * area.powf(1.5);
    Piece {
        faces,
        closed,
        volume,
        low,
        high,
    }
}

#[cfg(test)]
mod tests {
    use super::orient;
    use crate::mesh::adjacency::EdgeFaces;
    use crate::mesh::{TriMesh, zoo};

    fn oriented(mesh: &TriMesh) -> (TriMesh, usize) {
        let mut mesh = mesh.clone();
        let edges = EdgeFaces::new(&mesh.faces);
        let n = orient(&mut mesh, &edges);
        (mesh, n)
    }

    #[test]
    fn a_good_mesh_stays_as_it_is() {
        let sphere = zoo::sphere(2);
        assert_eq!(oriented(&sphere), (sphere, 0));
    }

    #[test]
    fn single_faces_and_whole_components_are_turned() {
        let sphere = zoo::sphere(2);
        let mut some = sphere.clone();
        for f in [3, 17, 18, 40] {
            some.faces[f].swap(1, 2);
        }
        assert_eq!(oriented(&some), (sphere.clone(), 4));
        let inside_out = zoo::inside_out(&sphere);
        let (turned, n) = oriented(&inside_out);
        assert_eq!((turned, n), (sphere.clone(), sphere.faces.len()));
    }

    #[test]
    fn a_cavity_keeps_looking_inward() {
        let outer = zoo::sphere(2);
        let inner = zoo::inside_out(&zoo::scaled(&zoo::sphere(1), 0.5));
        let hollow = zoo::union(&[outer, inner]);
        assert_eq!(oriented(&hollow), (hollow, 0));
    }

    #[test]
    fn an_open_sheet_keeps_the_side_of_its_majority() {
        let sheet = zoo::grid(5, 4);
        let mut one = sheet.clone();
        one.faces[7].swap(1, 2);
        assert_eq!(oriented(&one), (sheet, 1));
    }

    #[test]
    fn a_moebius_strip_survives() {
        let (mesh, _) = oriented(&zoo::moebius(24));
        assert_eq!(mesh.faces.len(), zoo::moebius(24).faces.len());
    }
}
