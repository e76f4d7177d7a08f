//! Evaluates a shape of primitives as a smooth function of space: negative inside, zero on the
//! surface.
//!
//! Primitives are joined by the quadratic smooth minimum (I. Quilez, "Smooth minimum"). It changes
//! values only where two of them differ by less than the blend width, so that parts which merely
//! pass near each other do not swell.

use super::solid::{Ball, Solid};
use super::vector::{Frame, Vec3, along, scale};

/// Smooth minimum of width `k`: exact where the two differ by `k` or more, or one is infinite.
fn smooth_min(a: f64, b: f64, k: f64) -> f64 {
    let h = (k - (a - b).abs()).max(0.0);
    if h > 0.0 {
        a.min(b) - h * h / (4.0 * k)
    } else {
        a.min(b)
    }
}

/// Solids that blend into earlier ones, or are cut out of them.
#[derive(Debug, Clone)]
pub(super) struct Limb {
    /// Blend width to earlier limbs.
    blend: f64,
    /// Blend width between its own solids.
    joint: f64,
    cut: bool,
    ball: Option<Ball>,
    solids: Vec<(Solid, u32, Ball)>,
}

impl Limb {
    /// Adds a solid with a label.
    pub(super) fn solid(&mut self, label: u32, solid: Solid) -> &mut Self {
        let ball = solid.ball();
        self.ball = Some(self.ball.map_or(ball, |all| all.with(ball)));
        self.solids.push((solid, label, ball));
        self
    }

    /// Adds the hull of two balls.
    pub(super) fn cone(&mut self, label: u32, a: Vec3, b: Vec3, ra: f64, rb: f64) -> &mut Self {
        self.solid(label, Solid::Cone { a, b, ra, rb })
    }

    /// Adds a tube along points, whose radius changes linearly from `ra` to `rb`.
    pub(super) fn tube(&mut self, label: u32, points: &[Vec3], ra: f64, rb: f64) -> &mut Self {
        self.solid(
            label,
            Solid::Tube {
                points: points.to_vec(),
                ra,
                rb,
            },
        )
    }

    /// Adds an ellipsoid.
    pub(super) fn ellipsoid(&mut self, label: u32, frame: Frame, radii: Vec3) -> &mut Self {
        self.solid(label, Solid::Ellipsoid { frame, radii })
    }

    /// Adds a box whose outer half sizes are `half`, with edges rounded by `round`.
    pub(super) fn block(&mut self, label: u32, frame: Frame, half: Vec3, round: f64) -> &mut Self {
        let half = half.map(|x| (x - round).max(0.0));
        self.solid(label, Solid::Block { frame, half, round })
    }

    /// Adds a cylinder of outer `radius` and half height `half`, with edges rounded by `round`.
    pub(super) fn disc(&mut self, label: u32, frame: Frame, radius: f64, half: f64, round: f64) {
        let (radius, half) = ((radius - round).max(0.0), (half - round).max(0.0));
        self.solid(
            label,
            Solid::Disc {
                frame,
                radius,
                half,
                round,
            },
        );
    }
}

/// A shape: limbs in the order in which they were built. The first solid contains the seed of the
/// surface.
#[derive(Debug, Clone, Default)]
pub(super) struct Scene {
    limbs: Vec<Limb>,
}

impl Scene {
    /// Begins a limb that blends over `blend` into the earlier ones, and whose own solids blend
    /// over `joint`.
    pub(super) fn limb(&mut self, blend: f64, joint: f64) -> &mut Limb {
        self.push(Limb {
            blend,
            joint,
            cut: false,
            ball: None,
            solids: Vec::new(),
        })
    }

    /// Begins a limb that is cut out of the earlier ones.
    pub(super) fn cut(&mut self, blend: f64) -> &mut Limb {
        self.push(Limb {
            blend,
            joint: 0.0,
            cut: true,
            ball: None,
            solids: Vec::new(),
        })
    }

    fn push(&mut self, limb: Limb) -> &mut Limb {
        self.limbs.push(limb);
        self.limbs
            .last_mut()
            .expect("invariant: a limb was just pushed")
    }

    /// The function whose zero set is the surface.
    pub(super) fn value(&self, p: Vec3) -> f64 {
        let mut value = f64::INFINITY;
        for limb in &self.limbs {
            // A limb that is farther away than the blend reaches has no effect.
            let reach = if limb.cut { -value } else { value } + limb.blend;
            if limb.ball.is_none_or(|ball| ball.distance(p) >= reach) {
                continue;
            }
            let mut own = f64::INFINITY;
            for (solid, _, ball) in &limb.solids {
                if ball.distance(p) < own + limb.joint {
                    own = smooth_min(own, solid.distance(p), limb.joint);
                }
            }
            value = if limb.cut {
                -smooth_min(-value, own, limb.blend)
            } else {
                smooth_min(value, own, limb.blend)
            };
        }
        value
    }

    /// The gradient of [`Scene::value`], by differences along the corners of a tetrahedron of size
    /// `step`.
    pub(super) fn gradient(&self, p: Vec3, step: f64) -> Vec3 {
        let corners = [
            [1.0, -1.0, -1.0],
            [-1.0, -1.0, 1.0],
            [-1.0, 1.0, -1.0],
            [1.0, 1.0, 1.0],
        ];
        let sum = corners.iter().fold([0.0; 3], |sum, &corner| {
            along(sum, corner, self.value(along(p, corner, step)))
        });
        scale(sum, 1.0 / (4.0 * step))
    }

    /// The label of the solid nearest to a point; ties go to the first.
    pub(super) fn label(&self, p: Vec3) -> u32 {
        let mut best = (f64::INFINITY, 0);
        for (solid, label, _) in self.limbs.iter().filter(|l| !l.cut).flat_map(|l| &l.solids) {
            let d = solid.distance(p);
            if d < best.0 {
                best = (d, *label);
            }
        }
        best.1
    }

    /// A point inside the first solid.
    pub(super) fn seed(&self) -> Vec3 {
        self.limbs[0].solids[0].0.inside()
    }

    /// Radius of the thinnest solid.
    pub(super) fn thickness(&self) -> f64 {
        let all = self.limbs.iter().filter(|l| !l.cut).flat_map(|l| &l.solids);
        all.map(|(solid, ..)| solid.thickness())
            .fold(f64::INFINITY, f64::min)
    }

    /// Labels its solids have, ascending.
    #[cfg(test)]
    pub(super) fn labels(&self) -> Vec<u32> {
        let solids = self.limbs.iter().filter(|l| !l.cut).flat_map(|l| &l.solids);
        solids
            .map(|s| s.1)
            .collect::<std::collections::BTreeSet<_>>()
            .into_iter()
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::{Scene, Solid};

    #[test]
    fn blending_changes_nothing_at_a_distance() {
        let ball = |x: f64| Solid::Cone {
            a: [x, 0.0, 0.0],
            b: [x, 0.1, 0.0],
            ra: 0.2,
            rb: 0.2,
        };
        let (mut smooth, mut sharp) = (Scene::default(), Scene::default());
        for (scene, k) in [(&mut smooth, 0.1), (&mut sharp, 0.0)] {
            scene.limb(0.0, 0.0).solid(0, ball(0.0));
            scene.limb(k, 0.0).solid(1, ball(0.3));
        }
        assert_eq!(
            smooth.value([-0.2, 0.0, 0.0]),
            sharp.value([-0.2, 0.0, 0.0])
        );
        assert!(smooth.value([0.15, 0.3, 0.0]) < sharp.value([0.15, 0.3, 0.0]));
        assert_eq!(
            (
                smooth.label([-0.1, 0.0, 0.0]),
                smooth.label([0.4, 0.0, 0.0])
            ),
            (0, 1)
        );
    }
}
