//! Answers with arrays at the vertices of the proxy, or at the vertices or polygons of the mesh as
//! it was sent.

use crate::Library;
use crate::daemon::answer::refused;
use crate::ipc::convert;
use crate::ipc::frames::FrameWriter;
use crate::ipc::wire;
use crate::library::{PointRequest, PolygonValues, Resolution};

/// A spectrum with eigenvectors.
pub(super) fn spectrum(
    library: &Library,
    r: &wire::GetSpectrumRequest,
    frames: &mut FrameWriter,
) -> Result<wire::GetSpectrumReply, wire::Error> {
    let resolution = convert::resolution(r.resolution(), Resolution::Proxy);
    let (collection, shape) = (&r.collection, &r.shape);
    let area = library.shape(collection, shape).map_err(refused)?.area;
    let shape = library.input_shape(collection, shape).map_err(refused)?;
    Ok(convert::spectrum_at(&shape, area, resolution, frames))
}

/// A heat kernel signature.
pub(super) fn hks(
    library: &Library,
    r: &wire::GetHksRequest,
    frames: &mut FrameWriter,
) -> Result<wire::GetHksReply, wire::Error> {
    let resolution = convert::resolution(r.resolution(), Resolution::Proxy);
    let shape = library.input_shape(&r.collection, &r.shape);
    Ok(convert::hks_at(
        &shape.map_err(refused)?,
        resolution,
        frames,
    ))
}

/// A map between points or, without options for one, a part map.
pub(super) fn functional_map(
    library: &Library,
    r: &wire::GetFunctionalMapRequest,
    frames: &mut FrameWriter,
) -> Result<wire::GetFunctionalMapReply, wire::Error> {
    let resolution = convert::resolution(r.resolution(), Resolution::Proxy);
    let (collection, from, to) = (&r.collection, &r.from, &r.to);
    let pair = match resolution {
        Resolution::Proxy => None,
        Resolution::Vertices | Resolution::Polygons => {
            let pair = library.input_pair(collection, from, to);
            Some(pair.map_err(refused)?)
        }
    };
    let reply = match &r.points {
        Some(points) => {
            let request = point_request(library, collection, (from, to), points)?;
            let found = library.point_maps(collection, from, to, &request);
            let mut maps = found.map_err(refused)?;
            if let Some(pair) = &pair {
                let at = |map| pair.point_map(map, resolution);
                maps = maps.into_iter().map(at).collect();
            }
            convert::point_maps(&maps, frames)
        }
        None => {
            let map = library.map(collection, from, to).map_err(refused)?;
            let standing = match r.agreement {
                true => {
                    let standing = library.standing(collection, from, to, &map);
                    standing.map_err(refused)?.map(convert::agreement)
                }
                false => None,
            };
            let map = match &pair {
                Some(pair) => pair.part_map(map, resolution),
                None => map,
            };
            wire::GetFunctionalMapReply {
                agreement: standing,
                ..convert::functional_map(&map, frames)
            }
        }
    };
    let n1 = match &pair {
        Some(pair) => pair.one().n_rows(resolution),
        None => library
            .n_proxy_vertices(collection, from)
            .map_err(refused)?,
    };
    Ok(convert::from_rows(reply, n1, resolution))
}

/// Transferred values.
pub(super) fn transfer(
    library: &Library,
    r: &wire::TransferFunctionRequest,
    values: &PolygonValues,
    frames: &mut FrameWriter,
) -> Result<wire::TransferFunctionReply, wire::Error> {
    let resolution = convert::resolution(r.resolution(), Resolution::Polygons);
    let (collection, shapes) = (&r.collection, (r.from.as_str(), r.to.as_str()));
    let points = r.points.clone().unwrap_or_default();
    let request = point_request(library, collection, shapes, &points)?;
    let (values, map) = library
        .transfer_at(collection, shapes, values, &request, resolution)
        .map_err(refused)?;
    Ok(convert::transferred(&values, &map, resolution, frames))
}

/// The options of a map between points of two shapes, with landmarks on the proxies.
fn point_request(
    library: &Library,
    collection: &str,
    shapes: (&str, &str),
    points: &wire::PointMapOptions,
) -> Result<PointRequest, wire::Error> {
    let request = convert::point_request(points);
    match points.landmark_resolution() {
        wire::Resolution::Input => library
            .landmarks_on_proxy(collection, shapes, request)
            .map_err(refused),
        _ => Ok(request),
    }
}
