//! Computes maps between the points of two stored shapes, and transfers values through them.

use super::error::{LibraryError, Result};
use super::facade::Library;
use super::reason::Reason;
use super::rows::{from_json, to_json};
use super::sources::Sources;
use crate::fmap::transfer::{faces_to_faces, labels_to_faces};
use crate::fmap::{
    Assessment, Basis, EstimateOptions, PointMap, PointShape, Quality, Side, point_maps,
};
use crate::pipeline::DescriptionView;
use crate::store::PointMapRow;
use serde::{Deserialize, Serialize};

/// Part of the key of a stored map. Raise it when the same request would result in another map.
const RECIPE: u32 = 1;

/// Requirements on a map between points.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PointRequest {
    /// Pairs of corresponding proxy vertices of the first and the second shape.
    pub landmarks: Vec<[u32; 2]>,
    /// The orientation of the map.
    pub side: Side,
    /// Number of rows and columns; 0: 100, or as many as both shapes have.
    pub k: usize,
    /// Whether to return also the best map of the other orientation.
    pub alternative: bool,
}

/// Values at the polygons of a shape.
#[derive(Debug, Clone, PartialEq)]
pub enum PolygonValues {
    /// Labels or other classes `(n_polygons,)`.
    Labels(Vec<i32>),
    /// Functions `(n_polygons, dim)`, row-major, and dim.
    Functions(Vec<f32>, usize),
}

impl Library {
    /// Returns the map that carries functions on `from` to `to` point by point and, if requested,
    /// the best one of the other orientation after it. The maps are stored, and found again by the
    /// same request.
    ///
    /// # Errors
    /// There is no such shape, or a landmark is not a vertex of its proxy.
    pub fn point_maps(
        &self,
        collection: &str,
        from: &str,
        to: &str,
        request: &PointRequest,
    ) -> Result<Vec<PointMap>> {
        if let Some(kept) = self.stored_point_maps(collection, from, to, request)? {
            return Ok(kept);
        }
        let (_, a) = self.shape_row(collection, from)?;
        let (_, b) = self.shape_row(collection, to)?;
        let key = request_key(request);
        let (one, two) = (self.store.known(a.id)?, self.store.known(b.id)?);
        let found = maps(&one.view(), &two.view(), request)?;
        let rows: Vec<PointMapRow> = found.iter().map(to_row).collect();
        let write = self
            .store
            .catalog()
            .write(|tx| -> Result<()> { Ok(tx.put_point_maps(a.id, b.id, &key, &rows)?) });
        // A map that cannot be stored, because a shape was removed meanwhile or the disk is full,
        // is computed again when it is requested again.
        match write {
            Err(LibraryError::Store(e)) if e.is_damage() => Err(e.into()),
            _ => rows.into_iter().map(from_row).collect(),
        }
    }

    /// Returns what [`Library::point_maps`] returns, if it is stored. Computes nothing.
    ///
    /// # Errors
    /// There is no such shape, or the map is damaged.
    pub fn stored_point_maps(
        &self,
        collection: &str,
        from: &str,
        to: &str,
        request: &PointRequest,
    ) -> Result<Option<Vec<PointMap>>> {
        let (_, a) = self.shape_row(collection, from)?;
        let (_, b) = self.shape_row(collection, to)?;
        let key = request_key(request);
        let kept = self
            .store
            .catalog()
            .read(|r| r.point_maps(a.id, b.id, &key).map_err(LibraryError::from))?;
        let kept = Some(kept).filter(|k| !k.is_empty());
        kept.map(|k| k.into_iter().map(from_row).collect())
            .transpose()
    }

    /// Transfers values at the polygons of `from` to those of `to`, by the map between their
    /// points. A polygon gets the most frequent label, or the mean of the functions, around the
    /// matched points; −1 or NaN where nothing corresponds.
    ///
    /// # Errors
    /// Those of [`Self::point_maps`]; or the number of rows differs from the number of polygons of
    /// `from`.
    pub fn transfer(
        &self,
        collection: &str,
        from: &str,
        to: &str,
        values: &PolygonValues,
        request: &PointRequest,
    ) -> Result<(PolygonValues, PointMap)> {
        let a = self.description(collection, from)?;
        let b = self.description(collection, to)?;
        let (one, two) = (a.view(), b.view());
        let n_polygons = one.face_map.len();
        let rows = match values {
            PolygonValues::Labels(labels) => labels.len(),
            PolygonValues::Functions(values, dim) => values.len() / (*dim).max(1),
        };
        if rows != n_polygons {
            let text = format!("values have {rows} rows, but {from:?} has {n_polygons} polygons");
            return Err(LibraryError::invalid(Reason::FieldRange, text));
        }
        let found = self.point_maps(collection, from, to, request)?;
        let map = found
            .into_iter()
            .next()
            .expect("invariant: there is a map between any two shapes");
        let n = one.vertices.len();
        let transferred = match values {
            PolygonValues::Labels(labels) => {
                let of_face = most_frequent(&one, labels);
                let faces =
                    labels_to_faces(one.faces, two.faces, n, &map.p2p_21, &map.matched, &of_face);
                let polygons = two.face_map.iter().map(|f| faces[*f as usize]);
                PolygonValues::Labels(polygons.collect())
            }
            PolygonValues::Functions(values, dim) => {
                let of_face = mean(&one, values, *dim);
                let (p2p, matched) = (&map.p2p_21, &map.matched);
                let faces = faces_to_faces(one.faces, two.faces, n, p2p, matched, &of_face, *dim);
                let polygons = two.face_map.iter();
                let rows = polygons.flat_map(|f| {
                    let at = *f as usize * dim;
                    faces[at..at + dim].iter().copied()
                });
                PolygonValues::Functions(rows.collect(), *dim)
            }
        };
        Ok((transferred, map))
    }
}

/// The stored fields of a map besides its arrays.
#[derive(Debug, Serialize, Deserialize)]
struct Detail {
    descriptor_residual: f64,
    orthogonality: f64,
    coverage: f64,
    near_zero: f64,
    matched: f64,
    round_trip: f64,
    smoothness: f64,
    orientation: f64,
    expected_error: f64,
    cost: f64,
}

/// Returns the key under which the maps of a request are stored.
fn request_key(request: &PointRequest) -> String {
    let PointRequest {
        landmarks,
        side,
        k,
        alternative,
    } = request;
    format!("{RECIPE} {side:?} {k} {alternative} {landmarks:?}")
}

fn to_row(map: &PointMap) -> PointMapRow {
    let detail = Detail {
        descriptor_residual: map.quality.descriptor_residual,
        orthogonality: map.quality.orthogonality,
        coverage: map.quality.coverage,
        near_zero: map.quality.near_zero,
        matched: map.quality.matched,
        round_trip: map.assessment.round_trip,
        smoothness: map.assessment.smoothness,
        orientation: map.orientation,
        expected_error: map.expected_error,
        cost: map.cost,
    };
    PointMapRow {
        k: map.k as u32,
        c_12: map.c_12.clone(),
        p2p_21: map.p2p_21.clone(),
        matched: map.matched.iter().map(|m| u8::from(*m)).collect(),
        detail_json: to_json(&detail),
    }
}

fn from_row(row: PointMapRow) -> Result<PointMap> {
    let detail: Detail = from_json(&row.detail_json, "point_maps")?;
    Ok(PointMap {
        c_12: row.c_12,
        k: row.k as usize,
        p2p_21: row.p2p_21,
        matched: row.matched.iter().map(|m| *m > 0).collect(),
        quality: Quality {
            descriptor_residual: detail.descriptor_residual,
            orthogonality: detail.orthogonality,
            coverage: detail.coverage,
            near_zero: detail.near_zero,
            matched: detail.matched,
            ..Quality::default()
        },
        assessment: Assessment {
            round_trip: detail.round_trip,
            smoothness: detail.smoothness,
        },
        orientation: detail.orientation,
        expected_error: detail.expected_error,
        cost: detail.cost,
    })
}

fn maps(
    one: &DescriptionView<'_>,
    two: &DescriptionView<'_>,
    request: &PointRequest,
) -> Result<Vec<PointMap>> {
    for landmark in &request.landmarks {
        for (vertex, shape) in landmark.iter().zip([one, two]) {
            let n = shape.vertices.len();
            if *vertex as usize >= n {
                let text = format!("a landmark names vertex {vertex}, but the proxy has {n}");
                return Err(LibraryError::invalid(Reason::FieldRange, text));
            }
        }
    }
    let mut options = EstimateOptions {
        side: request.side,
        alternative: request.alternative,
        ..EstimateOptions::default()
    };
    if request.k > 0 {
        for stage in &mut options.stages {
            stage.k = stage.k.min(request.k);
        }
    }
    let (one, two) = (shape(one, &options), shape(two, &options));
    Ok(point_maps(&one, &two, &request.landmarks, &options))
}

fn shape<'a>(d: &DescriptionView<'a>, options: &EstimateOptions) -> PointShape<'a> {
    let basis = Basis {
        eigenvalues: d.eigenvalues,
        eigenvectors: d.eigenvectors,
        n_eigenvectors: d.n_eigenvectors,
        mass: d.mass,
    };
    PointShape::new(d.vertices, d.faces, basis, options)
}

/// Returns the area-weighted mean of the polygons of each proxy face `(m, dim)`; 0 for a face
/// without polygons.
fn mean(d: &DescriptionView<'_>, values: &[f32], dim: usize) -> Vec<f32> {
    let mut sum = vec![0.0f64; d.faces.len() * dim];
    let mut area = vec![0.0f64; d.faces.len()];
    let polygons = d.face_map.iter().zip(d.polygon_area);
    for ((f, polygon), row) in polygons.zip(values.chunks_exact(dim.max(1))) {
        let weight = f64::from(*polygon).max(1e-12);
        area[*f as usize] += weight;
        for (s, x) in sum[*f as usize * dim..].iter_mut().zip(row) {
            *s += weight * f64::from(*x);
        }
    }
    let rows = sum.chunks_exact(dim.max(1)).zip(area);
    rows.flat_map(|(row, area)| row.iter().map(move |s| (s / area.max(1e-300)) as f32))
        .collect()
}

/// Returns the label with most area among the polygons of each proxy face `(m,)`; −1 for a face
/// without polygons, and the lowest label on ties.
fn most_frequent(d: &DescriptionView<'_>, labels: &[i32]) -> Vec<i32> {
    let mut kinds = labels.to_vec();
    kinds.sort_unstable();
    kinds.dedup();
    let mut area = vec![0.0f64; d.faces.len() * kinds.len()];
    for ((f, polygon), label) in d.face_map.iter().zip(d.polygon_area).zip(labels) {
        let kind = kinds.partition_point(|k| k < label);
        area[*f as usize * kinds.len() + kind] += f64::from(*polygon).max(1e-12);
    }
    let most = |row: &[f64]| {
        let mut best = (0.0, -1);
        for (x, kind) in row.iter().zip(&kinds) {
            if *x > best.0 {
                best = (*x, *kind);
            }
        }
        best.1
    };
    area.chunks_exact(kinds.len().max(1)).map(most).collect()
}
