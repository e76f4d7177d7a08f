//! Maps between sites of two shapes.

use super::{Around, InputMesh, Marks, NOWHERE, Sites, heaviest, nearest_in};
use crate::description::DescriptionView;

/// Images of the corners of a proxy face that are farther apart than this times the mean edge of
/// the proxy are not interpolated: the map is torn there.
const TORN_EDGES: f32 = 4.0;

/// For each site of shape 2 its corresponding site of shape 1.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SiteMap {
    /// A site of shape 1 `(sites of shape 2,)`; 0 for sites without a location.
    pub p2p_21: Vec<u32>,
    /// Whether the site has a counterpart; false without a location.
    pub matched: Vec<bool>,
    /// The corresponding points on the proxy of shape 1.
    points: Vec<[f32; 3]>,
}

impl SiteMap {
    /// The map between sites of two shapes, from the map between their proxies: `p2p_21` and
    /// `matched` have an element for each proxy vertex of shape 2. The image of a location is
    /// interpolated between those of the corners of its proxy face, and the nearest site of shape 1
    /// corresponds; the first of several at the same location.
    ///
    /// # Panics
    /// If no site of shape 1 has a location, or an array is too short.
    pub fn new(
        (one, view_1): (&Sites, &DescriptionView<'_>),
        (two, view_2): (&Sites, &DescriptionView<'_>),
        p2p_21: &[u32],
        matched: &[bool],
    ) -> Self {
        let mut search = Search::new(one, view_1);
        let mut map = Self::default();
        for (face, weights) in two.faces.iter().zip(&two.weights) {
            if *face == NOWHERE {
                map.p2p_21.push(0);
                map.matched.push(false);
                map.points.push([f32::NAN; 3]);
                continue;
            }
            let corners = view_2.faces[*face as usize];
            let images = corners.map(|v| p2p_21[v as usize]);
            let has = corners.map(|v| f32::from(u8::from(matched[v as usize])));
            let share: f32 = has.iter().zip(weights).map(|(m, w)| m * w).sum();
            let point = search.image(images, *weights);
            map.p2p_21.push(search.nearest(&point, images, *weights));
            map.matched.push(share >= 0.5);
            map.points.push(point);
        }
        map
    }

    /// Labels, or other values that are not interpolated, at the sites of shape 1 become values at
    /// those of shape 2; `none` without a counterpart.
    ///
    /// # Panics
    /// If there are fewer values than sites.
    pub fn pull<T: Copy>(&self, values: &[T], none: T) -> Vec<T> {
        let sites = self.p2p_21.iter().zip(&self.matched);
        sites
            .map(|(s, matched)| if *matched { values[*s as usize] } else { none })
            .collect()
    }

    /// Functions `(vertices of shape 1, dim)`, interpolated linearly within the triangles of shape
    /// 1, at the sites of shape 2 `(sites, dim)`; NaN without a counterpart. The sites of shape 1
    /// are its vertices.
    ///
    /// # Panics
    /// If there are fewer values than vertices.
    pub fn interpolate(
        &self,
        one: &InputMesh,
        view_1: &DescriptionView<'_>,
        values: &[f32],
        dim: usize,
    ) -> Vec<f32> {
        let points = one.vertices.points(view_1);
        let welded: Vec<[u32; 3]> = one
            .triangles
            .iter()
            .map(|t| t.map(|v| one.welded[v as usize]))
            .collect();
        let around = Around::new(one.vertices.len(), &welded);
        let mut out = Vec::with_capacity(self.p2p_21.len() * dim);
        for ((&site, matched), point) in self.p2p_21.iter().zip(&self.matched).zip(&self.points) {
            if !matched {
                out.extend(std::iter::repeat_n(f32::NAN, dim));
                continue;
            }
            let at = |v: u32| &values[v as usize * dim..(v as usize + 1) * dim];
            let nearby = match one.welded[site as usize] {
                u32::MAX => &[],
                v => around.of(v),
            };
            let nearest = nearby.iter().map(|t| {
                let triangle = one.triangles[*t as usize];
                let (distance, w) = nearest_in(point, triangle.map(|v| &points[v as usize]));
                (distance, triangle, w)
            });
            // The site itself, unless a point of a triangle around it is nearer.
            let mut best = (
                distance(point, &points[site as usize]),
                [site; 3],
                [1.0, 0.0, 0.0],
            );
            for found in nearest {
                if found.0 < best.0 {
                    best = found;
                }
            }
            let (_, triangle, weights) = best;
            let from = out.len();
            out.resize(from + dim, 0.0);
            for (v, w) in triangle.iter().zip(weights).filter(|(_, w)| *w > 0.0) {
                out[from..]
                    .iter_mut()
                    .zip(at(*v))
                    .for_each(|(x, y)| *x += w * y);
            }
        }
        out
    }
}

/// Finds the site of shape 1 that is nearest to a point near given proxy vertices.
struct Search<'a> {
    view: &'a DescriptionView<'a>,
    around: Around,
    /// The sites nearest to each proxy vertex.
    first: Vec<u32>,
    sites: Vec<u32>,
    points: Vec<[f32; 3]>,
    /// The largest squared distance of images that are interpolated.
    torn: f32,
    seen: Marks,
}

impl<'a> Search<'a> {
    fn new(sites: &Sites, view: &'a DescriptionView<'a>) -> Self {
        let n = view.vertices.len();
        let anchors: Vec<Option<u32>> = (0..sites.len())
            .map(|s| sites.proxy_vertex(view.faces, s))
            .collect();
        let mut first = vec![0u32; n + 1];
        anchors
            .iter()
            .flatten()
            .for_each(|v| first[*v as usize + 1] += 1);
        for v in 0..n {
            first[v + 1] += first[v];
        }
        assert!(first[n] > 0, "no site of the first shape has a location");
        let mut next = first.clone();
        let mut sorted = vec![0u32; first[n] as usize];
        for (s, v) in (0u32..).zip(&anchors).filter_map(|(s, v)| Some((s, (*v)?))) {
            sorted[next[v as usize] as usize] = s;
            next[v as usize] += 1;
        }
        let mean_edge = (4.0 / 3.0_f32.sqrt() / view.faces.len() as f32).sqrt();
        Self {
            view,
            around: Around::new(n, view.faces),
            first,
            sites: sorted,
            points: sites.points(view),
            torn: (TORN_EDGES * mean_edge).powi(2),
            seen: Marks::new(n),
        }
    }

    /// The image of a location whose corners have these images.
    fn image(&self, images: [u32; 3], weights: [f32; 3]) -> [f32; 3] {
        let at = images.map(|v| self.view.vertices[v as usize]);
        let far = [(0, 1), (1, 2), (2, 0)].iter().any(|&(i, j)| {
            weights[i] > 0.0 && weights[j] > 0.0 && distance(&at[i], &at[j]) > self.torn
        });
        if far {
            return at[heaviest(weights)];
        }
        std::array::from_fn(|i| (0..3).map(|c| weights[c] * at[c][i]).sum())
    }

    /// The site nearest to a point among those around the images; if there are none, among the
    /// first that are found farther out.
    fn nearest(&mut self, point: &[f32; 3], images: [u32; 3], weights: [f32; 3]) -> u32 {
        self.seen.clear();
        let mut ring: Vec<u32> = Vec::new();
        for (v, _) in images.iter().zip(weights).filter(|(_, w)| *w > 0.0) {
            if self.seen.add(*v) {
                ring.push(*v);
            }
        }
        let mut best: Option<(f32, u32)> = None;
        // Sites may be nearest to a proxy vertex beside the image, so two rings are searched
        // after the first site.
        let mut more = 2;
        loop {
            for v in &ring {
                let (a, b) = (self.first[*v as usize], self.first[*v as usize + 1]);
                for &site in &self.sites[a as usize..b as usize] {
                    let found = (distance(point, &self.points[site as usize]), site);
                    if best.is_none_or(|b| found < b) {
                        best = Some(found);
                    }
                }
            }
            if let Some((_, site)) = best {
                more -= 1;
                if more == 0 {
                    return site;
                }
            }
            ring = self.next_ring(&ring);
            if ring.is_empty() {
                return match best {
                    Some((_, site)) => site,
                    None => self.nearest_of_all(point),
                };
            }
        }
    }

    fn next_ring(&mut self, ring: &[u32]) -> Vec<u32> {
        let mut next = Vec::new();
        for v in ring {
            for face in self.around.of(*v) {
                for w in self.view.faces[*face as usize] {
                    if self.seen.add(w) {
                        next.push(w);
                    }
                }
            }
        }
        next
    }

    /// For images on a component that has no site.
    fn nearest_of_all(&self, point: &[f32; 3]) -> u32 {
        let all = self.sites.iter();
        let measured = all.map(|s| (distance(point, &self.points[*s as usize]), *s));
        let nearest = measured.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        nearest.expect("invariant: a site has a location").1
    }
}

/// Squared.
fn distance(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum()
}
