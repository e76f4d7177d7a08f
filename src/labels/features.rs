//! Makes face descriptors comparable across a collection: standardised, clipped and weighted by
//! group.

use crate::description::DescriptionView;
use crate::descriptors;

/// Standardised values are clipped to this number of standard deviations.
const CLIP: f64 = 4.0;

/// Face descriptors of one shape, row-major `(m, dim)`. With a known up axis they have
/// [`descriptors::N_UP_COLUMNS`] more columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Features {
    /// The values.
    pub data: Vec<f32>,
    /// Number of columns.
    pub dim: usize,
}

/// Returns names and widths of the descriptor groups, in the order of the columns.
pub(crate) fn groups(up_known: bool) -> Vec<(&'static str, usize)> {
    let mut groups = descriptors::GROUPS.to_vec();
    if up_known {
        groups.push(("up", descriptors::N_UP_COLUMNS));
    }
    groups
}

impl Features {
    /// Returns the descriptors of a shape without standardisation; `up` is the collection's up
    /// axis, if known.
    pub fn raw(shape: &DescriptionView<'_>, up: Option<[f64; 3]>) -> Self {
        let n = shape.n_descriptors;
        let Some(axis) = up else {
            return Self {
                data: shape.face_descriptors.to_vec(),
                dim: n,
            };
        };
        let columns = descriptors::up_columns(&shape.mesh(), axis);
        let dim = n + descriptors::N_UP_COLUMNS;
        let mut data = Vec::with_capacity(shape.faces.len() * dim);
        for (row, extra) in shape.face_descriptors.chunks_exact(n).zip(&columns) {
            data.extend_from_slice(row);
            data.extend_from_slice(extra);
        }
        Self { data, dim }
    }

    /// Returns values at vertices `(n, dim)`: area-weighted means over the adjacent faces.
    pub fn at_vertices(&self, n_vertices: usize, faces: &[[u32; 3]], area: &[f64]) -> Vec<f32> {
        let mut sum = vec![0.0f64; n_vertices * self.dim];
        let mut weight = vec![0.0f64; n_vertices];
        for (f, face) in faces.iter().enumerate() {
            for &v in face {
                let v = v as usize;
                weight[v] += area[f];
                let row = &self.data[f * self.dim..(f + 1) * self.dim];
                for (s, &x) in sum[v * self.dim..(v + 1) * self.dim].iter_mut().zip(row) {
                    *s += area[f] * f64::from(x);
                }
            }
        }
        sum.chunks_exact(self.dim)
            .zip(&weight)
            .flat_map(|(row, w)| row.iter().map(move |s| (s / w.max(1e-300)) as f32))
            .collect()
    }
}

/// Mean and deviation that standardise the descriptors of a collection.
#[derive(Debug, Clone, PartialEq)]
pub struct Normalisation {
    /// Area-weighted mean of each column.
    pub mean: Vec<f64>,
    /// Area-weighted standard deviation of each column.
    pub deviation: Vec<f64>,
    /// Whether the columns include those of the up axis.
    pub up_known: bool,
}

impl Normalisation {
    /// Computes mean and deviation over shapes of equal weight. Each shape has raw features and the
    /// area shares of its faces.
    pub fn fit<'a>(
        shapes: impl Iterator<Item = (&'a Features, &'a [f64])>,
        up_known: bool,
    ) -> Self {
        let (mut n, mut mean, mut square) = (0.0, Vec::new(), Vec::new());
        for (features, area) in shapes {
            mean.resize(features.dim, 0.0);
            square.resize(features.dim, 0.0);
            n += 1.0;
            for (row, a) in features.data.chunks_exact(features.dim).zip(area) {
                for (c, &x) in row.iter().enumerate() {
                    mean[c] += a * f64::from(x);
                    square[c] += a * f64::from(x) * f64::from(x);
                }
            }
        }
        let n = f64::max(n, 1.0);
        mean.iter_mut().for_each(|m| *m /= n);
        let deviation = square
            .iter()
            .zip(&mean)
            .map(|(s, m)| (s / n - m * m).max(0.0).sqrt() + 1e-9)
            .collect();
        Self {
            mean,
            deviation,
            up_known,
        }
    }

    /// Returns `clip((x − mean) / deviation, ±4) / √(width of the column's group)`. A normalisation
    /// that was fitted when the up axis had fewer columns uses the first of them.
    pub fn standardise(&self, raw: &Features) -> Features {
        let dim = self.mean.len();
        assert!(
            raw.dim == dim || (self.up_known && raw.dim > dim),
            "features have the {dim} columns of the normalisation, not {}",
            raw.dim
        );
        let mut scale = Vec::with_capacity(dim);
        for (_, width) in groups(self.up_known) {
            let width = width.min(dim - scale.len());
            scale.extend(std::iter::repeat_n(1.0 / (width as f64).sqrt(), width));
        }
        let standard = |(c, &x): (usize, &f32)| {
            let z = (f64::from(x) - self.mean[c]) / self.deviation[c];
            (z.clamp(-CLIP, CLIP) * scale[c]) as f32
        };
        let rows = raw.data.chunks_exact(raw.dim).map(|row| &row[..dim]);
        Features {
            data: rows
                .flat_map(|row| row.iter().enumerate().map(standard))
                .collect(),
            dim,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_knew_fewer_columns_of_the_up_axis_reads_the_first() {
        let n: usize = descriptors::GROUPS.iter().map(|g| g.1).sum();
        let all = n + descriptors::N_UP_COLUMNS;
        let raw = Features {
            data: (0..2 * all).map(|i| (i % all) as f32).collect(),
            dim: all,
        };
        let older = Normalisation {
            mean: vec![0.0; n + 3],
            deviation: vec![1e3; n + 3],
            up_known: true,
        };
        let found = older.standardise(&raw);
        assert_eq!((found.dim, found.data.len()), (n + 3, 2 * (n + 3)));
        for row in found.data.chunks_exact(n + 3) {
            let expected = (n + 2) as f64 / 1e3 / 3.0_f64.sqrt();
            assert!((f64::from(row[n + 2]) - expected).abs() < 1e-6);
        }
    }
}
