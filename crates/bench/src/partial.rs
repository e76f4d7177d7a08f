//! Measures whether maps recognise missing parts: labels are transferred from shapes that lack a
//! part.

use crate::error::BenchError;
use crate::stream::{Category, Known};
use crate::transfer::{Labelled, Ready, labelled};
use coseg::fmap::MapOptions;
use coseg::mesh::write::off;
use coseg::mesh::{FaceGeometry, Format, TriMesh};
use coseg::pipeline::{Params, Prepared, describe, map};
use rayon::prelude::*;
use serde_json::{Value, json};

/// One of this many shapes has a part cut off
const STRIDE: usize = 4;
/// and is mapped to this many others.
const N_TARGETS: usize = 3;
/// Share of the area that may be cut off.
const SHARE: std::ops::Range<f64> = 0.04..0.5;

/// Areas, over maps from shapes with a part cut off (`cut`) and from the same shapes whole
/// (`whole`).
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Mask {
    n_maps: usize,
    /// Area without counterpart that is reported as such.
    found: f64,
    /// Area without counterpart.
    missing: f64,
    /// Area that is reported as without counterpart.
    reported: f64,
    /// Area that is reported as such although nothing was cut off.
    reported_of_whole: f64,
}

impl Mask {
    pub(crate) fn sum(masks: &[&Self]) -> Self {
        let add = |a: Self, b: &&Self| Self {
            n_maps: a.n_maps + b.n_maps,
            found: a.found + b.found,
            missing: a.missing + b.missing,
            reported: a.reported + b.reported,
            reported_of_whole: a.reported_of_whole + b.reported_of_whole,
        };
        masks.iter().fold(Self::default(), add)
    }

    fn figures(&self) -> [f64; 4] {
        let n = self.n_maps.max(1) as f64;
        [
            self.missing / n,
            self.found / self.reported.max(1e-300),
            self.found / self.missing.max(1e-300),
            self.reported_of_whole / n,
        ]
    }

    pub(crate) fn json(&self) -> Value {
        let [missing, precision, recall, of_whole] = self.figures();
        json!({"maps": self.n_maps, "missing": missing, "precision": precision, "recall": recall,
               "said_of_whole": of_whole})
    }

    pub(crate) fn text(&self) -> String {
        let [missing, precision, recall, of_whole] = self.figures();
        format!(
            "{} maps from shapes with a part cut away, {missing:.3} of the target: nothing \
             corresponds with precision {precision:.2}, recall {recall:.2}; said of {of_whole:.4} \
             when nothing is cut away",
            self.n_maps
        )
    }
}

/// A shape without one of its parts, and the index of that part.
fn without_part(shape: &Known, kinds: &[i32], turn: usize) -> Option<(TriMesh, Vec<i32>, u32)> {
    let areas = FaceGeometry::new(&shape.mesh).areas;
    let total: f64 = areas.iter().sum();
    let share = |kind: i32| {
        let faces = shape.truth.iter().zip(&areas);
        faces
            .filter(|(l, _)| **l == kind)
            .map(|(_, a)| a)
            .sum::<f64>()
            / total
    };
    let fit: Vec<usize> = (0..kinds.len())
        .filter(|k| SHARE.contains(&share(kinds[*k])))
        .collect();
    let class = *fit.get(turn % fit.len().max(1))?;
    let kept = |f: &usize| shape.truth[*f] != kinds[class];
    let faces: Vec<usize> = (0..shape.truth.len()).filter(kept).collect();
    let mesh = TriMesh {
        vertices: shape.mesh.vertices.clone(),
        faces: faces.iter().map(|f| shape.mesh.faces[*f]).collect(),
    };
    Some((
        mesh,
        faces.iter().map(|f| shape.truth[*f]).collect(),
        class as u32,
    ))
}

/// Maps from shapes with one part cut off to others that have it.
pub(crate) fn cut_away(category: &Category, prep: &Ready) -> Result<Mask, BenchError> {
    let n = category.shapes.len();
    let masks: Vec<Mask> = (0..n)
        .step_by(STRIDE)
        .collect::<Vec<_>>()
        .into_par_iter()
        .map(|s| {
            let Some((mesh, truth, class)) =
                without_part(&category.shapes[s], &prep.kinds, s / STRIDE)
            else {
                return Ok(Mask::default());
            };
            let text = off(&mesh);
            let found = describe(text.as_bytes(), Format::Off, &Params::default(), &|_| true);
            let Ok(description) = found else {
                // The rest is not a surface.
                return Ok(Mask::default());
            };
            let cut = labelled(description, &truth, &prep.kinds);
            Ok(masked(&cut, (s, class), prep, n))
        })
        .collect::<Result<_, BenchError>>()?;
    Ok(Mask::sum(&masks.iter().collect::<Vec<_>>()))
}

fn masked(cut: &Labelled, (s, class): (usize, u32), prep: &Ready, n: usize) -> Mask {
    let view = cut.description.view();
    let prepared = Prepared::new(&view, &prep.model);
    let mut mask = Mask::default();
    for step in 0..N_TARGETS {
        let t = (s + 1 + 6 * step) % n;
        let target = &prep.shapes[t];
        let to = target.description.view();
        if t == s || !target.of_face.contains(&Some(class)) {
            continue;
        }
        let whole = &prep.shapes[s].description.view();
        let options = MapOptions::default();
        let to = (&to, &prep.prepared[t]);
        let partial = map((&view, &prepared), to, &options);
        let full = map((whole, &prep.prepared[s]), to, &options);
        mask.n_maps += 1;
        let mut around = vec![0.0; to.0.mass.len()];
        to.0.faces
            .iter()
            .flatten()
            .for_each(|v| around[*v as usize] += 1.0);
        for (face, truth) in to.0.faces.iter().zip(&target.of_face) {
            for v in face {
                let area = f64::from(to.0.mass[*v as usize]) / around[*v as usize];
                let missing = *truth == Some(class);
                let reported = !partial.confidence.is_matched(*v as usize);
                mask.missing += if missing { area } else { 0.0 };
                mask.reported += if reported { area } else { 0.0 };
                mask.found += if missing && reported { area } else { 0.0 };
                if !full.confidence.is_matched(*v as usize) {
                    mask.reported_of_whole += area;
                }
            }
        }
    }
    mask
}
