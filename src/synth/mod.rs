//! Generates labelled shapes from a family, a seed and a number: closed, smooth, varied in pose and
//! topology.
//!
//! Shapes are implicit surfaces of blended primitives. Each primitive has a label; a face has the
//! label of the nearest primitive. They are test fixtures and the input of the demonstration, so
//! the same seed gives the same bytes on every machine: the arithmetic is `+ - * / sqrt` throughout
//! (see `vector`).

mod dice;
mod families;
mod field;
mod parts;
mod remesh;
mod solid;
mod surface;
mod vector;

#[cfg(test)]
mod check;
#[cfg(test)]
mod tests;

use crate::mesh::TriMesh;
use dice::Dice;
use field::Scene;
use rayon::iter::{IntoParallelIterator, ParallelIterator};
use std::str::FromStr;
use vector::{cross, dot, norm, sub};

/// The least number of faces of a generated shape; with fewer, handles and legs are lost.
pub const LEAST_FACES: u32 = 1_000;

/// Vertices are rounded to a millionth, so that files are short and parse to the same mesh.
const DECIMALS: f64 = 1e6;

/// No shape reaches farther than this from its seed.
const REACH: f64 = 8.0;

/// A kind of shape whose members share parts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Family {
    /// Four-legged animals: dogs, giraffes, cows, and forms in between.
    Animal,
    /// Birds, standing or in flight, wings folded or spread.
    Bird,
    /// Chairs: four legs, pedestal or runners; solid or slatted back; with and without arms.
    Chair,
    /// Pliers at any opening.
    Pliers,
    /// Guitars: classical, electric with one or two horns, arrow-shaped, pear-shaped.
    Guitar,
    /// Cups, vases, jugs, goblets: none, one or two handles.
    Container,
    /// Candelabra with one to seven candles.
    Candelabra,
}

impl Family {
    /// Every family.
    pub const ALL: [Self; 7] = [
        Self::Animal,
        Self::Bird,
        Self::Chair,
        Self::Pliers,
        Self::Guitar,
        Self::Container,
        Self::Candelabra,
    ];

    /// Its name, which [`Family::from_str`] parses.
    pub fn name(self) -> &'static str {
        match self {
            Self::Animal => "animal",
            Self::Bird => "bird",
            Self::Chair => "chair",
            Self::Pliers => "pliers",
            Self::Guitar => "guitar",
            Self::Container => "container",
            Self::Candelabra => "candelabra",
        }
    }

    /// The meaning of its labels: label i is called `label_names()[i]`. A member may lack some.
    pub fn label_names(self) -> &'static [&'static str] {
        match self {
            Self::Animal => families::animal::LABELS,
            Self::Bird => families::bird::LABELS,
            Self::Chair => families::chair::LABELS,
            Self::Pliers => families::pliers::LABELS,
            Self::Guitar => families::guitar::LABELS,
            Self::Container => families::container::LABELS,
            Self::Candelabra => families::candelabra::LABELS,
        }
    }

    fn scene(self, dice: &mut Dice) -> Scene {
        match self {
            Self::Animal => families::animal::scene(dice),
            Self::Bird => families::bird::scene(dice),
            Self::Chair => families::chair::scene(dice),
            Self::Pliers => families::pliers::scene(dice),
            Self::Guitar => families::guitar::scene(dice),
            Self::Container => families::container::scene(dice),
            Self::Candelabra => families::candelabra::scene(dice),
        }
    }
}

impl std::fmt::Display for Family {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}

/// The error for an unknown family.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no family is called '{0}'; there are \
         {names}", names = Family::ALL.map(Family::name).join(", "))]
pub struct UnknownFamily(pub String);

impl FromStr for Family {
    type Err = UnknownFamily;

    fn from_str(name: &str) -> Result<Self, UnknownFamily> {
        let found = Self::ALL.into_iter().find(|f| f.name() == name);
        found.ok_or_else(|| UnknownFamily(name.to_owned()))
    }
}

/// Options of generation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// Number of faces of each mesh: at least [`LEAST_FACES`], and an odd number is lowered by one.
    pub n_faces: u32,
    /// Whether each shape is turned at random; otherwise +y is up and they face the same way.
    pub rotate: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            n_faces: 6_000,
            rotate: false,
        }
    }
}

/// A shape with known parts.
#[derive(Debug, Clone, PartialEq)]
pub struct Labelled {
    /// Closed, edge-manifold, one component, faces counter-clockwise seen from outside. About one
    /// unit high.
    pub mesh: TriMesh,
    /// A label per face.
    pub labels: Vec<u32>,
    /// The names of the labels; the same for the whole family.
    pub label_names: &'static [&'static str],
    /// Unique within family and seed: `chair-007` for index 6.
    pub name: String,
}

/// The first `count` members of a family for a seed, in order.
pub fn family(family: Family, seed: u64, count: u32, options: &Options) -> Vec<Labelled> {
    (0..count)
        .into_par_iter()
        .map(|index| generate(family, seed, index, options))
        .collect()
}

/// Member `index` of a family for a seed; it does not depend on the other members.
pub fn generate(family: Family, seed: u64, index: u32, options: &Options) -> Labelled {
    let scene = family.scene(&mut Dice::new(seed, family as u64, index, 0));
    let mut mesh = mesh_of(&scene, options.n_faces.max(LEAST_FACES) as usize);
    let labels = parts::labels(&scene, &mesh);
    if options.rotate {
        // The rotation has random numbers of its own, so that turning does not change the shape.
        let rows = Dice::new(seed, family as u64, index, 1).rotation();
        for v in &mut mesh.vertices {
            *v = rows.map(|row| dot(row, *v));
        }
    }
    for x in mesh.vertices.iter_mut().flatten() {
        // Adding zero turns -0 into 0.
        *x = (*x * DECIMALS).round() / DECIMALS + 0.0;
    }
    let name = format!("{family}-{:03}", u64::from(index) + 1);
    Labelled {
        mesh,
        labels,
        label_names: family.label_names(),
        name,
    }
}

/// The surface of a scene in about `n_faces` triangles of similar size.
fn mesh_of(scene: &Scene, n_faces: usize) -> TriMesh {
    let extract = |cell| {
        surface::surface(|p| scene.value(p), scene.seed(), cell, REACH)
            .expect("invariant: the seed of a scene lies inside, and scenes are bounded")
    };
    // Cells must be smaller than the thinnest part, and than the target triangles.
    let cell = (0.9 * scene.thickness()).min(0.05);
    let mut mesh = extract(cell);
    let area: f64 = mesh.faces.iter().map(|f| face_area(&mesh, f)).sum();
    let edge = (area / n_faces as f64 * 4.0 / 3f64.sqrt()).sqrt();
    if cell > 0.7 * edge {
        mesh = extract(0.7 * edge);
    }
    remesh::remesh(mesh, scene, n_faces)
}

fn face_area(mesh: &TriMesh, face: &[u32; 3]) -> f64 {
    let [a, b, c] = face.map(|v| mesh.vertices[v as usize]);
    norm(cross(sub(b, a), sub(c, a))) / 2.0
}
