//! Arrays at the vertices and polygons of shapes as they were sent, from those on their proxies.

use super::error::{LibraryError, Result};
use super::facade::Library;
use super::points::{PointRequest, PolygonValues};
use super::reason::Reason;
use super::rows::format_from_name;
use super::sources::{Sources, mapped_shape};
use super::types::MapInfo;
use crate::fmap::{Confidence, PointMap};
use crate::mesh::parse;
use crate::pipeline::DescriptionView;
use crate::sites::{InputMesh, InputMeshError, SiteMap, Sites};
use crate::store::MappedDescription;

/// What the rows of an array are of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Resolution {
    /// The vertices of the proxy.
    Proxy,
    /// The vertices of the mesh as sent, in the order of its file.
    Vertices,
    /// The polygons of the mesh as sent, in the order of its file.
    Polygons,
}

/// A stored shape with its mesh as it was sent.
#[derive(Debug)]
pub struct InputShape {
    name: String,
    description: MappedDescription,
    input: InputMesh,
}

/// Two of them, with the maps from the first to the second.
#[derive(Debug)]
pub struct InputPair {
    one: InputShape,
    two: InputShape,
}

impl Library {
    /// A shape with its mesh as it was sent: reads the file again and locates it on the proxy.
    ///
    /// # Errors
    /// There is no such shape, or an earlier release described it, in another way than this one.
    pub fn input_shape(&self, collection: &str, shape: &str) -> Result<InputShape> {
        let (within, row) = self.shape_row(collection, shape)?;
        let description = mapped_shape(&self.store, row.id)?.1;
        let bytes = self.store.original(&row.content_digest)?;
        let parsed = parse(&bytes, format_from_name(&row.format, "shapes.format")?);
        let parsed = parsed.map_err(|e| differs(shape, &e.to_string()))?;
        let input = InputMesh::new(&parsed, &description.view(), within.working_faces);
        let input = input.map_err(|e: InputMeshError| differs(shape, &e.to_string()))?;
        Ok(InputShape {
            name: shape.to_owned(),
            description,
            input,
        })
    }

    /// Two shapes with their meshes as they were sent.
    ///
    /// # Errors
    /// As [`Self::input_shape`].
    pub fn input_pair(&self, collection: &str, from: &str, to: &str) -> Result<InputPair> {
        Ok(InputPair {
            one: self.input_shape(collection, from)?,
            two: self.input_shape(collection, to)?,
        })
    }

    /// A request whose landmarks are vertices of the files of two shapes, with the nearest vertices
    /// of their proxies instead.
    ///
    /// # Errors
    /// As [`Self::input_shape`]; or a vertex does not exist, or no face uses it.
    pub fn landmarks_on_proxy(
        &self,
        collection: &str,
        (from, to): (&str, &str),
        request: PointRequest,
    ) -> Result<PointRequest> {
        if request.landmarks.is_empty() {
            return Ok(request);
        }
        let (one, two) = (
            self.input_shape(collection, from)?,
            self.input_shape(collection, to)?,
        );
        let pairs = request.landmarks.iter();
        let pairs = pairs.map(|&[a, b]| Ok([one.proxy_vertex(a)?, two.proxy_vertex(b)?]));
        Ok(PointRequest {
            landmarks: pairs.collect::<Result<_>>()?,
            ..request
        })
    }

    /// Values at `from` become values at `to`, by the map between their points. Those at polygons
    /// are transferred as by [`Self::transfer`]. Of those at vertices, of the proxies or of the
    /// files, labels become those of the corresponding vertices and functions are interpolated; −1
    /// and NaN where nothing corresponds.
    ///
    /// # Errors
    /// As [`Self::point_maps`] and [`Self::input_shape`]; or there is not one row for each vertex
    /// or polygon of `from`.
    pub fn transfer_at(
        &self,
        collection: &str,
        (from, to): (&str, &str),
        values: &PolygonValues,
        request: &PointRequest,
        resolution: Resolution,
    ) -> Result<(PolygonValues, PointMap)> {
        match resolution {
            Resolution::Polygons => self.transfer(collection, from, to, values, request),
            Resolution::Proxy => {
                let n1 = self.n_proxy_vertices(collection, from)?;
                check_rows(values, n1, &format!("the proxy of {from:?}"))?;
                let map = self.best_point_map(collection, from, to, request)?;
                Ok((transfer_on_proxy(values, &map), map))
            }
            Resolution::Vertices => {
                let pair = self.input_pair(collection, from, to)?;
                let n = pair.one.n_rows(resolution);
                check_rows(values, n, &format!("the file of {from:?}"))?;
                let map = self.best_point_map(collection, from, to, request)?;
                Ok((pair.transfer(values, &map), map))
            }
        }
    }

    fn best_point_map(
        &self,
        collection: &str,
        from: &str,
        to: &str,
        request: &PointRequest,
    ) -> Result<PointMap> {
        let found = self.point_maps(collection, from, to, request)?;
        let best = found.into_iter().next();
        Ok(best.expect("invariant: there is a map between any two shapes"))
    }
}

fn differs(shape: &str, why: &str) -> LibraryError {
    LibraryError::FailedPrecondition {
        reason: Reason::Mesh,
        message: format!(
            "shape {shape:?} was described by an earlier release ({why}): add it again with \
             --replace, or request the resolution of the proxy"
        ),
    }
}

impl InputShape {
    /// Its arrays on the proxy.
    pub fn view(&self) -> DescriptionView<'_> {
        self.description.view()
    }

    /// The number of rows of an array.
    pub fn n_rows(&self, resolution: Resolution) -> usize {
        match self.sites(resolution) {
            Some(sites) => sites.len(),
            None => self.view().vertices.len(),
        }
    }

    /// Values `(n, dim)` at the vertices of the proxy, interpolated linearly; NaN at vertices of
    /// the file that no polygon uses.
    pub fn interpolate(&self, values: &[f32], dim: usize, resolution: Resolution) -> Vec<f32> {
        match self.sites(resolution) {
            Some(sites) => sites.interpolate(self.view().faces, values, dim),
            None => values.to_vec(),
        }
    }

    /// The share of the total area that belongs to each row.
    pub fn mass(&self, resolution: Resolution) -> &[f32] {
        match resolution {
            Resolution::Proxy => self.description.view().mass,
            Resolution::Vertices => &self.input.vertex_mass,
            Resolution::Polygons => self.description.view().polygon_area,
        }
    }

    fn sites(&self, resolution: Resolution) -> Option<&Sites> {
        match resolution {
            Resolution::Proxy => None,
            Resolution::Vertices => Some(&self.input.vertices),
            Resolution::Polygons => Some(&self.input.polygons),
        }
    }

    /// The proxy vertex nearest to a vertex of the file.
    fn proxy_vertex(&self, vertex: u32) -> Result<u32> {
        let (name, n) = (&self.name, self.input.vertices.len());
        let refused = |text| Err(LibraryError::invalid(Reason::FieldRange, text));
        if vertex as usize >= n {
            return refused(format!(
                "a landmark names vertex {vertex}, but the file of {name:?} has {n} vertices"
            ));
        }
        let faces = self.view().faces;
        match self.input.vertices.proxy_vertex(faces, vertex as usize) {
            Some(v) => Ok(v),
            None => refused(format!(
                "a landmark names vertex {vertex} of {name:?}, which no face uses"
            )),
        }
    }
}

impl InputPair {
    /// Shape 1.
    pub fn one(&self) -> &InputShape {
        &self.one
    }

    /// A map between points with its pointwise map at a resolution.
    pub fn point_map(&self, map: PointMap, resolution: Resolution) -> PointMap {
        let Some(sites) = self.site_map(&map.p2p_21, &map.matched, resolution) else {
            return map;
        };
        PointMap {
            p2p_21: sites.p2p_21,
            matched: sites.matched,
            ..map
        }
    }

    /// A part map with its pointwise map and confidence at a resolution.
    pub fn part_map(&self, map: MapInfo, resolution: Resolution) -> MapInfo {
        let of_vertex = &map.confidence.of_vertex;
        let matched: Vec<bool> = of_vertex.iter().map(|c| *c > 0).collect();
        let Some(sites) = self.site_map(&map.p2p_21, &matched, resolution) else {
            return map;
        };
        let confidence = self.confidence(of_vertex, &sites.matched, resolution);
        MapInfo {
            p2p_21: sites.p2p_21,
            confidence: Confidence {
                of_vertex: confidence,
            },
            ..map
        }
    }

    /// Values at the vertices of the file of shape 1, at those of shape 2.
    fn transfer(&self, values: &PolygonValues, map: &PointMap) -> PolygonValues {
        let (view_1, view_2) = (self.one.view(), self.two.view());
        let sites = SiteMap::new(
            (&self.one.input.vertices, &view_1),
            (&self.two.input.vertices, &view_2),
            &map.p2p_21,
            &map.matched,
        );
        match values {
            PolygonValues::Labels(labels) => PolygonValues::Labels(sites.pull(labels, -1)),
            PolygonValues::Functions(x, dim) => {
                let moved = sites.interpolate(&self.one.input, &view_1, x, *dim);
                PolygonValues::Functions(moved, *dim)
            }
        }
    }

    fn site_map(
        &self,
        p2p_21: &[u32],
        matched: &[bool],
        resolution: Resolution,
    ) -> Option<SiteMap> {
        let (one, two) = (self.one.sites(resolution)?, self.two.sites(resolution)?);
        let views = (self.one.view(), self.two.view());
        Some(SiteMap::new(
            (one, &views.0),
            (two, &views.1),
            p2p_21,
            matched,
        ))
    }

    /// The confidence at the matched sites of shape 2: the mean of the matched corners around.
    fn confidence(&self, of_vertex: &[u8], matched: &[bool], resolution: Resolution) -> Vec<u8> {
        let values: Vec<f32> = of_vertex
            .iter()
            .flat_map(|c| [f32::from(*c), f32::from(u8::from(*c > 0))])
            .collect();
        let found = self.two.interpolate(&values, 2, resolution);
        let rows = found.as_chunks::<2>().0.iter().zip(matched);
        rows.map(|([sum, share], matched)| match matched {
            true => (sum / share).round().clamp(1.0, 255.0) as u8,
            false => 0,
        })
        .collect()
    }
}

/// Values at the vertices of the first proxy, at those of the second.
fn transfer_on_proxy(values: &PolygonValues, map: &PointMap) -> PolygonValues {
    let sites = map.p2p_21.iter().zip(&map.matched);
    match values {
        PolygonValues::Labels(labels) => {
            let at = |(v, matched): (&u32, &bool)| if *matched { labels[*v as usize] } else { -1 };
            PolygonValues::Labels(sites.map(at).collect())
        }
        PolygonValues::Functions(x, dim) => {
            let row = |(v, matched): (&u32, &bool)| {
                let row = &x[*v as usize * dim..(*v as usize + 1) * dim];
                let matched = *matched;
                row.iter().map(move |x| if matched { *x } else { f32::NAN })
            };
            PolygonValues::Functions(sites.flat_map(row).collect(), *dim)
        }
    }
}

fn check_rows(values: &PolygonValues, n: usize, whose: &str) -> Result<()> {
    let rows = match values {
        PolygonValues::Labels(labels) => labels.len(),
        PolygonValues::Functions(values, dim) => values.len() / (*dim).max(1),
    };
    if rows == n {
        return Ok(());
    }
    let text = format!("values have {rows} rows, but {whose} has {n} vertices");
    Err(LibraryError::invalid(Reason::FieldRange, text))
}
