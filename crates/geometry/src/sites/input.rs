//! The mesh as sent, located on its proxy.

use super::{Around, Marks, Sites, nearest_in};
use crate::description::DescriptionView;
use crate::mesh::{
    CleanError, Cleaned, ParsedMesh, clean, cross, norm, outer_shells, proxy, scale, sub,
};

/// The largest difference of a coordinate between the stored proxy and one computed again.
const TOLERANCE: f64 = 1e-5;

/// Why a mesh cannot be located on a proxy.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the fields are the values of the message
pub enum InputMeshError {
    #[error(transparent)]
    Clean(#[from] CleanError),
    #[error("the file has {found} polygons, but its description has {described}")]
    Polygons { found: usize, described: usize },
    #[error("the proxy of the file is not the one of its description")]
    Proxy,
}

/// A mesh as sent, with its vertices and polygons as sites on its proxy.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct InputMesh {
    /// The vertices of the file, in its order.
    pub vertices: Sites,
    /// The polygons of the file, in its order, by their centroids.
    pub polygons: Sites,
    /// The share of the total area that belongs to each vertex: a third of each triangle around it.
    pub vertex_mass: Vec<f32>,
    /// The triangles of the file, as vertices.
    pub(super) triangles: Vec<[u32; 3]>,
    /// For each vertex one that stands for all at the same position; `u32::MAX` if the analysed
    /// mesh has none.
    pub(super) welded: Vec<u32>,
}

impl InputMesh {
    /// Locates a parsed mesh on the proxy of its description, which was computed with
    /// `working_faces`. O(m log m), as describing it up to the proxy.
    ///
    /// ```
    /// use coseg_geometry::describe::describe;
    /// use coseg_geometry::description::Params;
    /// use coseg_geometry::mesh::{Format, icosphere, parse, write};
    /// use coseg_geometry::sites::InputMesh;
    ///
    /// let off = write::off(&icosphere(4));
    /// let params = Params { working_faces: 500, ..Params::default() };
    /// let described = describe(off.as_bytes(), Format::Off, &params, &|_| true)?;
    /// let (view, sent) = (described.view(), parse(off.as_bytes(), Format::Off)?);
    /// let input = InputMesh::new(&sent, &view, params.working_faces)?;
    /// assert_eq!((input.vertices.len(), input.polygons.len()), (2_562, 5_120));
    /// let one = input.vertices.interpolate(view.faces, &vec![1.0; view.vertices.len()], 1);
    /// assert!(one.iter().all(|x| (x - 1.0).abs() < 1e-6));
    /// # Ok::<_, Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// The mesh is not the one that was described, or was read differently then.
    pub fn new(
        parsed: &ParsedMesh,
        view: &DescriptionView<'_>,
        working_faces: u32,
    ) -> Result<Self, InputMeshError> {
        let (found, described) = (parsed.n_polygons, view.face_map.len());
        if found != described {
            return Err(InputMeshError::Polygons { found, described });
        }
        let cleaned = outer_shells(clean(parsed)?);
        let place = placed(&cleaned, view, working_faces)?;
        let points: Vec<[f32; 3]> = parsed.vertices.iter().map(|p| place(*p)).collect();
        let mut locate = Locate::new(view);
        let n = parsed.vertices.len();
        let around = Around::new(n, &parsed.triangles);
        let proxy_face = |t: &u32| view.face_map[parsed.polygon_of_triangle[*t as usize] as usize];
        let mut vertices = Sites::default();
        for (v, point) in (0u32..).zip(&points) {
            vertices.push(locate.nearest(point, around.of(v).iter().map(proxy_face)));
        }
        let mut polygons = Sites::default();
        for (polygon, centroid) in centroids(parsed).into_iter().enumerate() {
            let near = std::iter::once(view.face_map[polygon]);
            polygons.push(locate.nearest(&place(centroid), near));
        }
        let representative = representatives(&cleaned);
        Ok(Self {
            vertices,
            polygons,
            vertex_mass: vertex_mass(parsed),
            triangles: parsed.triangles.clone(),
            welded: representative,
        })
    }
}

/// The map from coordinates of the file to those of the proxy.
fn placed(
    cleaned: &Cleaned,
    view: &DescriptionView<'_>,
    working_faces: u32,
) -> Result<impl Fn([f64; 3]) -> [f32; 3] + use<>, InputMeshError> {
    let again = proxy(&cleaned.mesh, working_faces);
    let near = |(a, b): (&[f64; 3], &[f32; 3])| {
        a.iter()
            .zip(b)
            .all(|(x, y)| (x - f64::from(*y)).abs() < TOLERANCE)
    };
    if again.mesh.faces != view.faces || !again.mesh.vertices.iter().zip(view.vertices).all(near) {
        return Err(InputMeshError::Proxy);
    }
    let (centroid, first) = (cleaned.centroid, cleaned.scale);
    let (center, second) = (again.center, again.factor);
    Ok(move |p| {
        let cleaned = scale(sub(p, centroid), first);
        scale(sub(cleaned, center), second).map(|x| x as f32)
    })
}

/// Finds the nearest points of the proxy around given faces.
struct Locate<'a> {
    view: &'a DescriptionView<'a>,
    around: Around,
    seen: Marks,
}

impl<'a> Locate<'a> {
    fn new(view: &'a DescriptionView<'a>) -> Self {
        Self {
            view,
            around: Around::new(view.vertices.len(), view.faces),
            seen: Marks::new(view.faces.len()),
        }
    }

    /// The nearest point of the faces that share a corner with one of `near`; `None` without any.
    fn nearest(
        &mut self,
        point: &[f32; 3],
        near: impl Iterator<Item = u32>,
    ) -> Option<(u32, [f32; 3])> {
        self.seen.clear();
        let mut best: Option<(f32, u32, [f32; 3])> = None;
        for middle in near {
            for corner in self.view.faces[middle as usize] {
                for &face in self.around.of(corner) {
                    if !self.seen.add(face) {
                        continue;
                    }
                    let corners = self.view.faces[face as usize];
                    let corners = corners.map(|v| &self.view.vertices[v as usize]);
                    let (distance, weights) = nearest_in(point, corners);
                    if best.is_none_or(|b| distance < b.0) {
                        best = Some((distance, face, weights));
                    }
                }
            }
        }
        best.map(|(_, face, weights)| (face, weights))
    }
}

/// The centroid of each polygon, weighted by the areas of its triangles.
fn centroids(parsed: &ParsedMesh) -> Vec<[f64; 3]> {
    let mut sums = vec![([0.0; 3], 0.0, [0.0; 3], 0.0); parsed.n_polygons];
    for (t, polygon) in parsed.triangles.iter().zip(&parsed.polygon_of_triangle) {
        let (weighted, total, plain, count) = &mut sums[*polygon as usize];
        let corners = t.map(|v| parsed.vertices[v as usize]);
        let area = area(corners);
        for i in 0..3 {
            let middle = (corners[0][i] + corners[1][i] + corners[2][i]) / 3.0;
            weighted[i] += area * middle;
            plain[i] += middle;
        }
        *total += area;
        *count += 1.0;
    }
    // A polygon without area has the mean of its corners.
    let mean = |(weighted, total, plain, count): ([f64; 3], f64, [f64; 3], f64)| {
        let found = scale(weighted, 1.0 / total);
        if found.iter().all(|x| x.is_finite()) {
            found
        } else {
            scale(plain, 1.0 / count)
        }
    };
    sums.into_iter().map(mean).collect()
}

fn area([a, b, c]: [[f64; 3]; 3]) -> f64 {
    0.5 * norm(cross(sub(b, a), sub(c, a)))
}

fn vertex_mass(parsed: &ParsedMesh) -> Vec<f32> {
    let mut mass = vec![0.0; parsed.vertices.len()];
    for t in &parsed.triangles {
        let third = area(t.map(|v| parsed.vertices[v as usize])) / 3.0;
        t.iter().for_each(|v| mass[*v as usize] += third);
    }
    let total: f64 = mass.iter().sum();
    mass.into_iter().map(|m| (m / total) as f32).collect()
}

/// For each vertex the first one that cleaning welded it with.
fn representatives(cleaned: &Cleaned) -> Vec<u32> {
    let mut first = vec![u32::MAX; cleaned.mesh.vertices.len()];
    let representative = |(v, welded): (u32, &Option<u32>)| {
        let Some(welded) = welded else {
            return u32::MAX;
        };
        let first = &mut first[*welded as usize];
        if *first == u32::MAX {
            *first = v;
        }
        *first
    };
    (0u32..)
        .zip(&cleaned.vertex_of_vertex)
        .map(representative)
        .collect()
}
