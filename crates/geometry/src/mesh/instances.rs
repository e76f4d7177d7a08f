//! Labels of polygons become part instances: the connected pieces of each label, such as four legs.
//!
//! Polygons are connected through edges between equal positions, so seams of texture coordinates
//! and files without shared vertices do not matter. Meshes of real files have loose pieces (screws,
//! decals) and labels have crumbs at their boundaries; a piece that is small beside the largest one
//! of its label is therefore counted with the nearest piece that is not.

use super::{cross, norm, sub};
use crate::linalg::nearest::nearest_rows;
use std::collections::{BTreeMap, HashMap};

/// A piece with less than this share of the area of its label's largest piece is no instance of its
/// own: crumbs of a cut have some thousandths, the least of a chair's four legs more than a half.
const MIN_SHARE: f64 = 0.02;
/// A label in more pieces than this is one instance: its mesh does not connect what belongs
/// together.
const MAX_INSTANCES: usize = 256;

/// Which part instance each polygon belongs to.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Instances {
    /// Instance of each polygon.
    pub of_polygon: Vec<u32>,
    /// Label of each instance, ascending.
    pub labels: Vec<i32>,
    /// Number of each instance among those of its label, from 1, in the order of their first
    /// polygons.
    pub numbers: Vec<u32>,
}

/// The part instances of a labelled mesh. Polygons of different `objects` are never in one
/// instance, whatever their labels.
///
/// ```
/// use coseg_geometry::mesh::instances;
///
/// // Three triangles of one label; the first two share an edge.
/// let vertices: Vec<[f64; 3]> = (0..7).map(|i| [f64::from(i), f64::from(i * i), 0.0]).collect();
/// let polygons = [[0, 1, 2], [1, 3, 2], [4, 5, 6]];
/// let found = instances(&vertices, &polygons, &[3, 3, 3], &[0, 0, 0]);
/// assert_eq!(found.of_polygon, [0, 0, 1]);
/// assert_eq!((found.labels, found.numbers), (vec![3, 3], vec![1, 2]));
/// ```
///
/// # Panics
/// If there is not one label and one object per polygon.
pub fn instances<P: AsRef<[u32]>>(
    vertices: &[[f64; 3]],
    polygons: &[P],
    labels: &[i32],
    objects: &[u32],
) -> Instances {
    assert_eq!(polygons.len(), labels.len(), "one label per polygon");
    assert_eq!(polygons.len(), objects.len(), "one object per polygon");
    let pieces = pieces(vertices, polygons, labels, objects);
    // Pieces of each label, in the order of their first polygons.
    let mut of_label: BTreeMap<i32, Vec<&Vec<u32>>> = BTreeMap::new();
    for piece in &pieces {
        let label = labels[piece[0] as usize];
        of_label.entry(label).or_default().push(piece);
    }
    let mut found = Instances {
        of_polygon: vec![0; polygons.len()],
        ..Instances::default()
    };
    for (label, pieces) in of_label {
        let merged = if pieces.len() > MAX_INSTANCES {
            by_object(&pieces, objects)
        } else {
            join_small(vertices, polygons, objects, &pieces)
        };
        let mut number_of: BTreeMap<usize, u32> = BTreeMap::new();
        for (piece, into) in pieces.iter().zip(merged) {
            let n = number_of.len() as u32;
            let instance = *number_of.entry(into).or_insert_with(|| {
                found.labels.push(label);
                found.numbers.push(n + 1);
                found.labels.len() as u32 - 1
            });
            for &polygon in *piece {
                found.of_polygon[polygon as usize] = instance;
            }
        }
    }
    found
}

/// Connected polygons of one label and object, by their first polygons; polygons ascending.
fn pieces<P: AsRef<[u32]>>(
    vertices: &[[f64; 3]],
    polygons: &[P],
    labels: &[i32],
    objects: &[u32],
) -> Vec<Vec<u32>> {
    // Adding zero makes -0 and 0 one.
    let key = |v: u32| vertices[v as usize].map(|x| (x + 0.0).to_bits());
    let mut vertex_at: HashMap<[u64; 3], u32> = HashMap::with_capacity(vertices.len());
    let mut root: Vec<u32> = (0..polygons.len() as u32).collect();
    let mut first_at: HashMap<(u32, u32, i32, u32), u32> = HashMap::new();
    for (polygon, corners) in (0u32..).zip(polygons) {
        let corners = corners.as_ref();
        let welded: Vec<u32> = corners
            .iter()
            .map(|&v| *vertex_at.entry(key(v)).or_insert(v))
            .collect();
        let (label, object) = (labels[polygon as usize], objects[polygon as usize]);
        for (i, &a) in welded.iter().enumerate() {
            let b = welded[(i + 1) % welded.len()];
            let edge = (a.min(b), a.max(b), label, object);
            let other = *first_at.entry(edge).or_insert(polygon);
            let (a, b) = (find(&mut root, polygon), find(&mut root, other));
            root[a.max(b) as usize] = a.min(b);
        }
    }
    let mut pieces: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for polygon in 0..polygons.len() as u32 {
        let first = find(&mut root, polygon);
        pieces.entry(first).or_default().push(polygon);
    }
    pieces.into_values().collect()
}

fn find(root: &mut [u32], mut polygon: u32) -> u32 {
    while root[polygon as usize] != polygon {
        root[polygon as usize] = root[root[polygon as usize] as usize];
        polygon = root[polygon as usize];
    }
    polygon
}

/// For each piece the first one of its object.
fn by_object(pieces: &[&Vec<u32>], objects: &[u32]) -> Vec<usize> {
    let mut first: HashMap<u32, usize> = HashMap::new();
    let object = |piece: &Vec<u32>| objects[piece[0] as usize];
    let pieces = pieces.iter().enumerate();
    pieces
        .map(|(i, piece)| *first.entry(object(piece)).or_insert(i))
        .collect()
}

/// For each piece of a label the piece that it is counted with: itself, or if it is small the
/// nearest large one of its object, if there is one.
fn join_small<P: AsRef<[u32]>>(
    vertices: &[[f64; 3]],
    polygons: &[P],
    objects: &[u32],
    pieces: &[&Vec<u32>],
) -> Vec<usize> {
    let areas: Vec<f64> = pieces
        .iter()
        .map(|piece| {
            let corners = piece.iter().map(|&p| polygons[p as usize].as_ref());
            corners.map(|c| area(vertices, c)).sum()
        })
        .collect();
    let largest = areas.iter().copied().fold(0.0, f64::max);
    let is_small = |i: usize| areas[i] < MIN_SHARE * largest;
    let mut into: Vec<usize> = (0..pieces.len()).collect();
    let mut of_object: BTreeMap<u32, [Vec<usize>; 2]> = BTreeMap::new();
    for (i, piece) in pieces.iter().enumerate() {
        let sides = of_object.entry(objects[piece[0] as usize]).or_default();
        sides[usize::from(is_small(i))].push(i);
    }
    let points = |i: usize| {
        let corners = pieces[i]
            .iter()
            .flat_map(|&p| polygons[p as usize].as_ref());
        corners.map(|&v| vertices[v as usize].map(|x| x as f32))
    };
    for [large, small] in of_object.values() {
        if large.is_empty() || small.is_empty() {
            continue;
        }
        let (mut targets, mut piece_of) = (Vec::new(), Vec::new());
        for &i in large {
            targets.extend(points(i).flatten());
            piece_of.resize(targets.len() / 3, i);
        }
        let centres: Vec<f32> = small.iter().flat_map(|&i| mean(points(i))).collect();
        for (&i, at) in small.iter().zip(nearest_rows(&centres, &targets, 3)) {
            into[i] = piece_of[at as usize];
        }
    }
    into
}

fn mean(points: impl Iterator<Item = [f32; 3]>) -> [f32; 3] {
    let (mut sum, mut n) = ([0.0; 3], 0.0);
    for point in points {
        sum = std::array::from_fn(|i| sum[i] + f64::from(point[i]));
        n += 1.0;
    }
    sum.map(|x| (x / f64::max(n, 1.0)) as f32)
}

/// Area of a polygon: half the length of its Newell normal.
pub(super) fn area(vertices: &[[f64; 3]], corners: &[u32]) -> f64 {
    let at = |i: usize| vertices[corners[i % corners.len()] as usize];
    let mut normal = [0.0; 3];
    for i in 1..corners.len() {
        let part = cross(sub(at(i), at(0)), sub(at(i + 1), at(0)));
        normal = std::array::from_fn(|k| normal[k] + part[k]);
    }
    0.5 * norm(normal)
}

#[cfg(test)]
mod tests {
    use super::{MAX_INSTANCES, instances};

    /// Squares in a plane, each with vertices of its own, at `x` with side `side`.
    fn squares(places: &[(f64, f64)]) -> (Vec<[f64; 3]>, Vec<[u32; 4]>) {
        let (mut vertices, mut polygons) = (Vec::new(), Vec::new());
        for &(x, side) in places {
            let n = vertices.len() as u32;
            let corners = [(x, 0.0), (x + side, 0.0), (x + side, side), (x, side)];
            vertices.extend(corners.map(|(x, y)| [x, y, 0.0]));
            polygons.push([n, n + 1, n + 2, n + 3]);
        }
        (vertices, polygons)
    }

    #[test]
    fn pieces_are_joined_across_seams_but_not_across_labels_and_objects() {
        let (vertices, polygons) = squares(&[(0.0, 1.0), (1.0, 1.0), (5.0, 1.0), (2.0, 1.0)]);
        let found = instances(&vertices, &polygons, &[7, 7, 7, 7], &[0; 4]);
        assert_eq!(found.of_polygon, [0, 0, 1, 0]);
        assert_eq!(found.numbers, [1, 2]);
        let found = instances(&vertices, &polygons, &[7, -1, 7, 7], &[0; 4]);
        assert_eq!(found.labels, [-1, 7, 7, 7]);
        assert_eq!(found.of_polygon, [1, 0, 2, 3]);
        let found = instances(&vertices, &polygons, &[7; 4], &[0, 1, 1, 1]);
        assert_eq!(found.of_polygon, [0, 1, 2, 1]);
    }

    #[test]
    fn a_crumb_belongs_to_the_nearest_piece_of_its_object() {
        let (vertices, polygons) = squares(&[(0.0, 1.0), (7.0, 0.1), (9.0, 1.0), (2.0, 0.1)]);
        let found = instances(&vertices, &polygons, &[4; 4], &[0; 4]);
        assert_eq!(found.of_polygon, [0, 1, 1, 0]);
        // Alone in its object it is a piece of its own.
        let found = instances(&vertices, &polygons, &[4; 4], &[0, 1, 0, 0]);
        assert_eq!(found.of_polygon, [0, 1, 2, 0]);
    }

    #[test]
    fn a_mesh_that_connects_nothing_is_one_instance_of_each_label_and_object() {
        let places: Vec<(f64, f64)> = (0..MAX_INSTANCES).map(|i| (2.0 * i as f64, 1.0)).collect();
        let (vertices, polygons) = squares(&places);
        let labels = vec![0; places.len()];
        let objects: Vec<u32> = (0..places.len() as u32).map(|i| i % 2).collect();
        let found = instances(&vertices, &polygons, &labels, &objects);
        assert_eq!(found.labels.len(), MAX_INSTANCES);
        let (vertices, polygons) = squares(&[places, vec![(-5.0, 1.0)]].concat());
        let (labels, objects) = ([labels, vec![0]].concat(), [objects, vec![1]].concat());
        let found = instances(&vertices, &polygons, &labels, &objects);
        assert_eq!(found.numbers, [1, 2]);
        assert_eq!(found.of_polygon[..4], [0, 1, 0, 1]);
    }
}
