//! Test shapes with known parts: strips of faces, whose parts differ in descriptors and meet at
//! creases.

use super::{DiscoveryInput, Features, Links, ShapeInput};
use crate::segmentation::{PatchGraph, Surface, SurfaceEdge};
use rand::{Rng, SeedableRng};

const FACES_A_PATCH: usize = 4;
const PATCHES_A_PART: usize = 6;
/// Number of descriptor columns of real shapes with up columns, so that group weights apply.
const DIM: usize = 92;

/// Strips of equal parts, and the part of each face of every strip.
pub(super) struct Strips {
    shapes: Vec<(Surface, PatchGraph, Features)>,
    pub(super) truth: Vec<u32>,
}

impl Strips {
    /// Builds `n` strips of `k` parts. Descriptors of a part spread by `noise` around the part's
    /// mean.
    pub(super) fn new(n: usize, k: usize, noise: f32) -> Self {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        let m = k * PATCHES_A_PART * FACES_A_PATCH;
        let truth: Vec<u32> = (0..m)
            .map(|f| (f / (PATCHES_A_PART * FACES_A_PATCH)) as u32)
            .collect();
        let centres: Vec<f32> = (0..k * DIM).map(|_| rng.random_range(-1.0..1.0)).collect();
        let patches: Vec<u32> = (0..m).map(|f| (f / FACES_A_PATCH) as u32).collect();
        let shapes = (0..n)
            .map(|_| {
                let edges = (1..m).map(|f| {
                    let creased = truth[f] != truth[f - 1];
                    SurfaceEdge {
                        faces: [f as u32 - 1, f as u32],
                        length: 1.0,
                        crease: if creased { 0.5 } else { 0.01 },
                        boundary_cost: if creased { 0.1 } else { 1.0 },
                    }
                });
                let surface = Surface {
                    area: vec![1.0 / m as f64; m],
                    centroids: (0..m).map(|f| [f as f64 / m as f64, 0.0, 0.0]).collect(),
                    edges: edges.collect(),
                };
                let data = truth.iter().flat_map(|t| {
                    let centre = &centres[*t as usize * DIM..(*t as usize + 1) * DIM];
                    centre
                        .iter()
                        .map(|c| c + rng.random_range(-noise..noise))
                        .collect::<Vec<_>>()
                });
                let features = Features {
                    data: data.collect(),
                    dim: DIM,
                };
                let patches = PatchGraph::new(&surface, &patches);
                (surface, patches, features)
            })
            .collect();
        Self { shapes, truth }
    }

    pub(super) fn input(&self) -> DiscoveryInput<'_> {
        let shapes = self
            .shapes
            .iter()
            .map(|(surface, patches, features)| ShapeInput {
                surface,
                patches,
                features,
            });
        DiscoveryInput {
            shapes: shapes.collect(),
            up_known: false,
            links: Links::default(),
        }
    }

    /// Returns the share of faces whose label is right up to one renaming; all strips have the same
    /// parts.
    pub(super) fn right(&self, labels: &[Vec<u32>]) -> f64 {
        let count = |max: Option<&u32>| 1 + max.map_or(0, |t| *t as usize);
        let (n, k) = (
            count(labels.iter().flatten().max()),
            count(self.truth.iter().max()),
        );
        let mut cost = vec![0.0; n * k];
        for labels in labels {
            for (l, t) in labels.iter().zip(&self.truth) {
                cost[*l as usize * k + *t as usize] -= 1.0;
            }
        }
        let matched = crate::linalg::assignment::assignment(&cost, n, k);
        let pairs = matched.iter().enumerate();
        let right: f64 = pairs.filter_map(|(l, t)| t.map(|t| -cost[l * k + t])).sum();
        right / (labels.len() * self.truth.len()) as f64
    }
}
