//! Shapes of one class that share a frame become an estimate of the up axis.
//!
//! An object that stands has a wide base under its centre of mass (Fu, Cohen-Or, Dror and Sheffer
//! 2008, *Upright Orientation of Man-Made Objects*). Each shape votes for the signed coordinate
//! axis along which it stands best.

use crate::description::DescriptionView;

/// Share of the height that counts as the base.
const BASE: f64 = 0.03;
/// Factor of the score if the centre of mass is not above the base.
const UNSTABLE: f64 = 0.2;
/// Least share of the shapes that must agree. By chance, one of six axes would get a sixth.
const LEAST_AGREEMENT: f64 = 0.5;

/// Ratio of two scores from which on a shape stands clearly better along the other axis. Tables
/// stand about twice as well on their plate as on their feet; of chairs that lie on a side, more
/// than half stand three times as well on their feet.
const CLEARLY: f64 = 3.0;
/// Least number of shapes that can contradict a given axis. A single shape that lies on its side
/// says nothing about the collection.
const LEAST_SHAPES: usize = 3;

/// The axis along which most shapes of a collection stand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpVote {
    /// A unit vector: a coordinate axis or its opposite.
    pub axis: [f64; 3],
    /// Share of the shapes that agree, 0 to 1.
    pub agreement: f64,
}

impl UpVote {
    /// Returns the axis, unless fewer than half of the shapes agree.
    pub fn trusted(&self) -> Option<[f64; 3]> {
        (self.agreement >= LEAST_AGREEMENT).then_some(self.axis)
    }
}

/// Returns the axis along which most shapes stand, and the share that agrees; `None` without
/// shapes.
pub fn estimate_up<'a>(shapes: impl Iterator<Item = &'a DescriptionView<'a>>) -> Option<UpVote> {
    vote(shapes, |_, _| true)
}

/// Returns the axis other than `given` along which most shapes stand clearly better, and their
/// share of all; `None` if there are too few shapes. If the vote is [trusted](UpVote::trusted), the
/// given axis is probably wrong.
pub fn contradicting_up<'a>(given: [f64; 3], shapes: &[&'a DescriptionView<'a>]) -> Option<UpVote> {
    let at = axes().iter().position(|axis| *axis == given)?;
    let better =
        |scores: &[f64; 6], best: usize| best != at && scores[best] >= CLEARLY * scores[at];
    let vote = vote(shapes.iter().copied(), better)?;
    (shapes.len() >= LEAST_SHAPES).then_some(vote)
}

/// The coordinate axes: +x, -x, +y, -y, +z, -z.
fn axes() -> [[f64; 3]; 6] {
    std::array::from_fn(|i| {
        let mut axis = [0.0; 3];
        axis[i / 2] = if i % 2 == 0 { 1.0 } else { -1.0 };
        axis
    })
}

/// Returns the axis with most votes, and its share. Each shape votes for the axis along which it
/// stands best, if `counts` accepts the scores.
fn vote<'a>(
    shapes: impl Iterator<Item = &'a DescriptionView<'a>>,
    counts: impl Fn(&[f64; 6], usize) -> bool,
) -> Option<UpVote> {
    let axes = axes();
    let (mut votes, mut sums, mut n) = ([0usize; 6], [0.0; 6], 0usize);
    for shape in shapes {
        let scores = axes.map(|axis| standing(shape, axis));
        let best = (0..6).max_by(|&a, &b| scores[a].total_cmp(&scores[b]).then(b.cmp(&a)))?;
        votes[best] += usize::from(counts(&scores, best));
        n += 1;
        for (sum, score) in sums.iter_mut().zip(scores) {
            *sum += score;
        }
    }
    let better = |a: &usize, b: &usize| {
        votes[*a]
            .cmp(&votes[*b])
            .then(sums[*a].total_cmp(&sums[*b]))
            .then(b.cmp(a))
    };
    let winner = (0..6).max_by(better)?;
    (n > 0).then(|| UpVote {
        axis: axes[winner],
        agreement: votes[winner] as f64 / n as f64,
    })
}

/// Returns how well a shape stands along an axis: the area of the convex hull of its base relative
/// to that of the whole outline, seen from above; less if the centre of mass is not above the base.
fn standing(shape: &DescriptionView<'_>, axis: [f64; 3]) -> f64 {
    let k = (0..3).find(|c| axis[*c] != 0.0).unwrap_or(0);
    let (u, v) = ((k + 1) % 3, (k + 2) % 3);
    let height = |p: &[f32; 3]| axis[k] * f64::from(p[k]);
    let flat = |p: &[f32; 3]| [f64::from(p[u]), f64::from(p[v])];
    let heights: Vec<f64> = shape.vertices.iter().map(height).collect();
    let low = heights.iter().copied().fold(f64::INFINITY, f64::min);
    let high = heights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let base_below = low + BASE * (high - low);
    let all = hull(shape.vertices.iter().map(flat).collect());
    let is_base = |(p, h): (&[f32; 3], &f64)| (*h <= base_below).then(|| flat(p));
    let base = hull(
        shape
            .vertices
            .iter()
            .zip(&heights)
            .filter_map(is_base)
            .collect(),
    );
    let mut centre = [0.0; 2];
    for (p, m) in shape.vertices.iter().zip(shape.mass) {
        let q = flat(p);
        centre[0] += f64::from(*m) * q[0];
        centre[1] += f64::from(*m) * q[1];
    }
    let ratio = area(&base) / area(&all).max(1e-12);
    if contains(&base, centre) {
        ratio
    } else {
        UNSTABLE * ratio
    }
}

fn turn(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// Computes the convex hull, counter-clockwise (Andrew's monotone chain).
fn hull(mut points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let mut chain: Vec<[f64; 2]> = Vec::new();
    for upper in [false, true] {
        let start = chain.len();
        let ordered: Vec<[f64; 2]> = if upper {
            points.iter().rev().copied().collect()
        } else {
            points.clone()
        };
        for p in ordered {
            while chain.len() >= start + 2
                && turn(chain[chain.len() - 2], chain[chain.len() - 1], p) <= 0.0
            {
                chain.pop();
            }
            chain.push(p);
        }
        chain.pop();
    }
    chain
}

fn area(polygon: &[[f64; 2]]) -> f64 {
    let n = polygon.len();
    (0..n)
        .map(|i| {
            let (p, q) = (polygon[i], polygon[(i + 1) % n]);
            (p[0] * q[1] - q[0] * p[1]) / 2.0
        })
        .sum()
}

fn contains(polygon: &[[f64; 2]], p: [f64; 2]) -> bool {
    let n = polygon.len();
    n >= 3 && (0..n).all(|i| turn(polygon[i], polygon[(i + 1) % n], p) >= 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::Description;

    /// Builds a pyramid with a square base and height 2 along `axis`.
    fn pyramid(axis: usize, sign: f32) -> Description {
        let mut vertices = Vec::new();
        for (a, b) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
            let mut p = [0.0f32; 3];
            p[axis] = -sign;
            p[(axis + 1) % 3] = a;
            p[(axis + 2) % 3] = b;
            vertices.push(p);
        }
        let mut tip = [0.0; 3];
        tip[axis] = sign;
        vertices.push(tip);
        Description {
            mass: vec![0.2; 5],
            vertices,
            ..Description::default()
        }
    }

    #[test]
    fn a_pyramid_stands_on_its_base() {
        for axis in 0..3 {
            for sign in [1.0f32, -1.0] {
                let shape = pyramid(axis, sign);
                let vote = estimate_up([shape.view()].iter()).unwrap();
                assert_eq!(vote.trusted().unwrap()[axis], f64::from(sign));
                assert_eq!(vote.agreement, 1.0);
            }
        }
    }

    #[test]
    fn shapes_that_disagree_have_no_up() {
        let shapes: Vec<Description> = (0..3).map(|axis| pyramid(axis, 1.0)).collect();
        let views: Vec<DescriptionView<'_>> = shapes.iter().map(Description::view).collect();
        let vote = estimate_up(views.iter()).unwrap();
        assert!((vote.agreement - 1.0 / 3.0).abs() < 1e-12);
        assert_eq!(vote.trusted(), None);
        assert_eq!(estimate_up([].iter()), None);
    }

    #[test]
    fn a_given_axis_is_contradicted_by_shapes_that_stand_clearly_better_along_another() {
        let [x, y, down] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]];
        let shapes: Vec<Description> = (0..4).map(|i| pyramid(usize::from(i < 3), 1.0)).collect();
        let views: Vec<DescriptionView<'_>> = shapes.iter().map(Description::view).collect();
        let views: Vec<&DescriptionView<'_>> = views.iter().collect();
        let vote = contradicting_up(x, &views).unwrap();
        assert_eq!((vote.trusted(), vote.agreement), (Some(y), 0.75));
        assert_eq!(contradicting_up(down, &views).unwrap().trusted(), Some(y));
        // One shape of four says nothing about the collection.
        assert_eq!(contradicting_up(y, &views).unwrap().trusted(), None);
        // Two shapes are too few, and `given` must be a coordinate axis.
        assert_eq!(contradicting_up(x, &views[..2]), None);
        assert_eq!(contradicting_up([0.6, 0.8, 0.0], &views), None);
    }

    #[test]
    fn what_stands_on_every_side_contradicts_nothing() {
        let mut cube = pyramid(0, 1.0);
        cube.vertices.pop();
        for i in 0..4 {
            let [_, a, b] = cube.vertices[i];
            cube.vertices.push([1.0, a, b]);
        }
        cube.mass = vec![0.125; 8];
        let view = cube.view();
        for given in axes() {
            let vote = contradicting_up(given, &[&view; 3]).unwrap();
            assert_eq!(vote.trusted(), None, "{given:?}");
        }
    }
}
