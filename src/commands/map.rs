//! `coseg map` shows the functional map between two shapes, and the parts that it matches.

use super::render::pair;
use super::session::Session;
use super::{CommandError, Outcome, json};
use crate::cli::{Map, Resolution};
use coseg::call;
use coseg::ipc::wire::{self, ArrayRef, DataType};
use coseg::text::table;
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use serde_json::json;
use std::path::Path;

pub(crate) fn run(args: &Map, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    let request = wire::GetFunctionalMapRequest {
        collection: collection.clone(),
        from: args.from.clone(),
        to: args.to.clone(),
        points: args.points.then(|| options(&args.landmark, args.mirrored)),
        agreement: true,
        resolution: wire::Resolution::Proxy.into(),
    };
    let at_rows = wire::GetFunctionalMapRequest {
        agreement: false,
        resolution: rows(args.resolution).into(),
        ..request.clone()
    };
    let (map, frames) = call!(session.client, GetFunctionalMap(request), frames)?;
    if !args.landmark.is_empty() {
        check_rows(map.resolution(), Resolution::Proxy)?;
    }
    if let Some(path) = &args.out {
        let (map, frames) = call!(session.client, GetFunctionalMap(at_rows), frames)?;
        check_rows(map.resolution(), args.resolution)?;
        write_arrays(
            path,
            &[
                ("c_12", &map.c_12),
                ("p2p_21", &map.p2p_21),
                ("matched", &map.matched),
                ("confidence", &map.confidence),
            ],
            &frames,
        )?;
    }
    if let Some(path) = &args.png {
        let sheet = pair::Sheet {
            from: pair::Side::receive(&mut session, &collection, &args.from)?,
            to: pair::Side::receive(&mut session, &collection, &args.to)?,
            c_12: array(&map.c_12, &frames, f32::from_le_bytes),
            columns: map
                .c_12
                .as_ref()
                .and_then(|c| c.shape.get(1))
                .map_or(0, |k| *k as usize),
            p2p_21: array(&map.p2p_21, &frames, u32::from_le_bytes),
        };
        let file = |source| CommandError::File {
            path: path.display().to_string(),
            source,
        };
        std::fs::write(path, sheet.png().map_err(file)?).map_err(file)?;
    }
    let parts = if args.points {
        wire::GetPartCorrespondenceReply::default()
    } else {
        let request = wire::GetPartCorrespondenceRequest {
            collection,
            shape_a: args.from.clone(),
            shape_b: args.to.clone(),
        };
        call!(session.client, GetPartCorrespondence(request))?
    };
    let shape = map
        .c_12
        .as_ref()
        .map(|c| c.shape.clone())
        .unwrap_or_default();
    let quality = map.quality.unwrap_or_default();
    if session.json {
        let matches: Vec<_> = parts.matches.iter().map(json::part_match).collect();
        session.print_json(&json!({
            "from": args.from,
            "to": args.to,
            "c_12_shape": shape,
            "quality": json::quality(&quality),
            "agreement": map.agreement.as_ref().map(json::agreement),
            "alternative_quality": map.alternative_quality.as_ref().map(json::quality),
            "alternative_cost": map.alternative_cost,
            "matches": matches,
        }))?;
        return Ok(true);
    }
    let size: Vec<String> = shape.iter().map(u64::to_string).collect();
    session.line(&format!(
        "{} to {}: c_12 ({}), descriptor residual {:.3}, orthogonality {:.3}, coverage {:.2}, \
         near zero {:.2}",
        args.from,
        args.to,
        size.join(", "),
        quality.descriptor_residual,
        quality.orthogonality,
        quality.coverage,
        quality.near_zero
    ))?;
    session.line(&match_line(&quality))?;
    if args.points {
        session.line(&point_line(&quality, map.alternative_cost))?;
        return Ok(true);
    }
    if let Some(agreement) = &map.agreement {
        session.line(&agreement_line(agreement))?;
    }
    let (from, to) = (
        format!("part of {}", args.from),
        format!("part of {}", args.to),
    );
    let mut rows = vec![vec![
        from,
        "label".to_owned(),
        to,
        "label".to_owned(),
        "overlap".to_owned(),
    ]];
    rows.extend(parts.matches.iter().map(|m| {
        vec![
            m.part_a.to_string(),
            m.label_a.to_string(),
            m.part_b.to_string(),
            m.label_b.to_string(),
            format!("{:.2}", m.overlap),
        ]
    }));
    session.line(&table(&rows))?;
    Ok(true)
}

/// The options of a map between points.
pub(super) fn options(landmarks: &[(u32, u32)], mirrored: bool) -> wire::PointMapOptions {
    let orientation = if mirrored {
        wire::MapOrientation::Reverse
    } else {
        wire::MapOrientation::Unspecified
    };
    wire::PointMapOptions {
        landmarks: landmarks
            .iter()
            .map(|&(from, to)| wire::Landmark { from, to })
            .collect(),
        orientation: orientation.into(),
        k: 0,
        alternative: true,
        landmark_resolution: wire::Resolution::Input.into(),
    }
}

/// The rows of arrays as a request names them.
pub(super) fn rows(resolution: Resolution) -> wire::Resolution {
    match resolution {
        Resolution::Input => wire::Resolution::Input,
        Resolution::InputFaces => wire::Resolution::InputFaces,
        Resolution::Proxy => wire::Resolution::Proxy,
    }
}

/// Refuses arrays with other rows than requested, which older daemons send.
pub(super) fn check_rows(found: wire::Resolution, wanted: Resolution) -> Result<(), CommandError> {
    let wanted = rows(wanted);
    if found == wanted {
        return Ok(());
    }
    let text = format!(
        "the daemon answers with rows of {}, not {}: it is older than this program",
        found.as_str_name(),
        wanted.as_str_name()
    );
    Err(CommandError::Failed(text))
}

/// The share with a counterpart, and the expected accuracy of transferred labels.
pub(super) fn match_line(q: &wire::MapQuality) -> String {
    let mut line = format!(
        "{:.1} % of the second shape has a counterpart",
        100.0 * q.matched()
    );
    if let Some(confidence) = q.confidence {
        line += &format!(
            "; a transferred label is expected to be right on {:.1} %",
            100.0 * confidence
        );
    }
    line
}

/// The agreement of a map with the others of its collection.
fn agreement_line(a: &wire::MapAgreement) -> String {
    let (n, departure) = (a.n_triangles, a.departure);
    match (n, a.inconsistent) {
        (0 | 1, _) => {
            format!("triangles with other maps: {n}, too few to decide whether it agrees")
        }
        (_, false) => {
            format!("agrees with other maps around {n} triangles (departure {departure:.2})")
        }
        (_, true) => format!(
            "does not agree with other maps around {n} triangles (departure {departure:.2}); \
             coseg check --repair recomputes it"
        ),
    }
}

/// Further figures of a map between points, and the cost of its alternative.
fn point_line(q: &wire::MapQuality, alternative: Option<f64>) -> String {
    let orientation = q.orientation();
    let turned = if orientation < 0.0 {
        "reverses"
    } else {
        "keeps"
    };
    let other = match alternative {
        Some(cost) => format!("the other orientation costs {cost:.2} times as much"),
        None => "no map of the other orientation was found".to_owned(),
    };
    format!(
        "{turned} orientation ({orientation:.2}), round trip {:.3}, smoothness {:.2}, expected \
         error {:.3} of the root of the area; {other}",
        q.round_trip(),
        q.smoothness(),
        q.expected_error(),
    )
}

/// The elements of a received array; an empty array if it is missing.
fn array<T>(
    array: &Option<ArrayRef>,
    frames: &[bytes::Bytes],
    read: impl Fn([u8; 4]) -> T,
) -> Vec<T> {
    let frame = array.as_ref().and_then(|a| frames.get(a.frame as usize));
    let words = frame.map(|f| f.as_chunks::<4>().0).unwrap_or_default();
    words.iter().map(|w| read(*w)).collect()
}

/// Writes arrays as received: frames and safetensors are both little-endian and row-major.
fn write_arrays(
    path: &Path,
    arrays: &[(&str, &Option<ArrayRef>)],
    frames: &[bytes::Bytes],
) -> Result<(), CommandError> {
    let bad = |e: String| CommandError::Failed(format!("{}: {e}", path.display()));
    let mut tensors = Vec::new();
    for (name, array) in arrays {
        let Some(array) = array else { continue };
        let dtype = match array.dtype() {
            DataType::Int32 => Dtype::I32,
            DataType::Uint32 => Dtype::U32,
            DataType::Float32 => Dtype::F32,
            DataType::Float64 => Dtype::F64,
            DataType::Unspecified => return Err(bad(format!("{name} has no element type"))),
        };
        let frame = frames
            .get(array.frame as usize)
            .map(AsRef::as_ref)
            .unwrap_or_default();
        let shape = array.shape.iter().map(|&n| n as usize).collect();
        let view = TensorView::new(dtype, shape, frame).map_err(|e| bad(e.to_string()))?;
        tensors.push((name.to_string(), view));
    }
    safetensors::serialize_to_file(tensors, None, path).map_err(|e| bad(e.to_string()))
}
