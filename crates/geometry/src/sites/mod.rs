//! Values at the vertices and polygons of a mesh as it was sent, from values on its proxy, and maps
//! between such meshes from maps between their proxies.
//!
//! A *site* is a vertex or a polygon of the mesh as sent. Each has a location on the proxy: the
//! nearest point of the proxy faces around those that its polygons are mapped to, so that the two
//! sides of a thin wall stay apart. Functions on the proxy are interpolated there. Two sites
//! correspond if their locations do.

mod image;
mod input;

pub use image::SiteMap;
pub use input::{InputMesh, InputMeshError};

use crate::description::DescriptionView;
use crate::fmap::precise::nearest_in_triangle;

/// A site so close to a proxy vertex, in barycentric coordinates, is at that vertex: coordinates in
/// single precision are not more accurate.
const SNAP: f32 = 1e-5;
/// The proxy face of a site without a location.
const NOWHERE: u32 = u32::MAX;

/// The vertices, or the polygons, of a mesh as sent, with their locations on its proxy.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Sites {
    faces: Vec<u32>,
    weights: Vec<[f32; 3]>,
}

impl Sites {
    /// Number of sites.
    pub fn len(&self) -> usize {
        self.faces.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.faces.is_empty()
    }

    /// Whether a site has a location: a vertex without a polygon has none.
    ///
    /// # Panics
    /// If the site does not exist.
    pub fn has_location(&self, site: usize) -> bool {
        self.faces[site] != NOWHERE
    }

    /// Values `(n, dim)` at the vertices of the proxy, interpolated linearly at the sites `(sites,
    /// dim)`; NaN at sites without a location.
    ///
    /// # Panics
    /// If there are fewer values than vertices.
    pub fn interpolate(&self, proxy_faces: &[[u32; 3]], values: &[f32], dim: usize) -> Vec<f32> {
        let mut out = Vec::with_capacity(self.len() * dim);
        for (face, weights) in self.faces.iter().zip(&self.weights) {
            if *face == NOWHERE {
                out.extend(std::iter::repeat_n(f32::NAN, dim));
                continue;
            }
            let corners = proxy_faces[*face as usize];
            let used = corners.iter().zip(weights).filter(|(_, w)| **w > 0.0);
            let from = out.len();
            out.resize(from + dim, 0.0);
            for (v, w) in used {
                let row = &values[*v as usize * dim..(*v as usize + 1) * dim];
                out[from..]
                    .iter_mut()
                    .zip(row)
                    .for_each(|(x, y)| *x += w * y);
            }
        }
        out
    }

    /// The proxy vertex nearest to a site; `None` if it has no location.
    ///
    /// # Panics
    /// If the site does not exist.
    pub fn proxy_vertex(&self, proxy_faces: &[[u32; 3]], site: usize) -> Option<u32> {
        let face = self.faces[site];
        (face != NOWHERE).then(|| proxy_faces[face as usize][heaviest(self.weights[site])])
    }

    fn push(&mut self, location: Option<(u32, [f32; 3])>) {
        let (face, weights) = location.unwrap_or((NOWHERE, [0.0; 3]));
        self.faces.push(face);
        self.weights.push(weights);
    }

    /// The locations in space; sites without one get NaN.
    fn points(&self, view: &DescriptionView<'_>) -> Vec<[f32; 3]> {
        let points = self.interpolate(view.faces, view.vertices.as_flattened(), 3);
        points.as_chunks::<3>().0.to_vec()
    }
}

/// The corner with the largest weight; the first on ties.
fn heaviest(weights: [f32; 3]) -> usize {
    (1..3).fold(
        0,
        |best, i| if weights[i] > weights[best] { i } else { best },
    )
}

/// For each vertex the faces around it, in the order of the faces.
struct Around {
    first: Vec<u32>,
    faces: Vec<u32>,
}

impl Around {
    /// `faces` name vertices below `n`, or `u32::MAX`, which is no vertex.
    fn new(n: usize, faces: &[[u32; 3]]) -> Self {
        let corners = || faces.as_flattened().iter().filter(|v| **v != u32::MAX);
        let mut first = vec![0u32; n + 1];
        corners().for_each(|v| first[*v as usize + 1] += 1);
        for v in 0..n {
            first[v + 1] += first[v];
        }
        let mut next = first.clone();
        let mut sorted = vec![0u32; first[n] as usize];
        for (f, face) in (0u32..).zip(faces) {
            for v in face.iter().filter(|v| **v != u32::MAX) {
                let slot = &mut next[*v as usize];
                sorted[*slot as usize] = f;
                *slot += 1;
            }
        }
        Self {
            first,
            faces: sorted,
        }
    }

    fn of(&self, vertex: u32) -> &[u32] {
        let v = vertex as usize;
        &self.faces[self.first[v] as usize..self.first[v + 1] as usize]
    }
}

/// A set of small integers that is emptied at no cost.
struct Marks {
    round: u32,
    marked: Vec<u32>,
}

impl Marks {
    fn new(n: usize) -> Self {
        Self {
            round: 0,
            marked: vec![0; n],
        }
    }

    fn clear(&mut self) {
        self.round += 1;
    }

    /// Adds an integer; false if it was there.
    fn add(&mut self, i: u32) -> bool {
        std::mem::replace(&mut self.marked[i as usize], self.round) != self.round
    }
}

/// The nearest point of a triangle in barycentric coordinates, exactly a corner if it is close to
/// one, and its squared distance.
fn nearest_in(point: &[f32; 3], corners: [&[f32; 3]; 3]) -> (f32, [f32; 3]) {
    let (distance, weights) = nearest_in_triangle(point, corners.map(|c| &c[..]));
    let corner = heaviest(weights);
    if weights[corner] < 1.0 - SNAP {
        return (distance, weights);
    }
    let mut exact = [0.0; 3];
    exact[corner] = 1.0;
    (distance, exact)
}

#[cfg(test)]
mod tests;
