//! Computes the signed distance of a primitive: exact, or exact to first order at the surface.
//!
//! After I. Quilez, "Distance functions".

use super::vector::{Frame, Vec3, along, dot, norm, scale, sub};

/// A primitive.
#[derive(Debug, Clone)]
pub(super) enum Solid {
    /// The hull of two spheres.
    Cone { a: Vec3, b: Vec3, ra: f64, rb: f64 },
    /// The hulls of neighbouring balls along a curve, whose radii change linearly from `ra` to
    /// `rb`.
    Tube { points: Vec<Vec3>, ra: f64, rb: f64 },
    /// Half axes along the frame.
    Ellipsoid { frame: Frame, radii: Vec3 },
    /// A box with half sizes that exclude the rounding, which is added outside.
    Block {
        frame: Frame,
        half: Vec3,
        round: f64,
    },
    /// A closed polygon in the frame's first two axes, `half` thick along the third, plus the
    /// rounding.
    Plate {
        frame: Frame,
        outline: Vec<[f64; 2]>,
        half: f64,
        round: f64,
    },
    /// All points within `round` of the curve (radius, height) turned around the frame's second
    /// axis.
    Shell {
        frame: Frame,
        profile: Vec<[f64; 2]>,
        round: f64,
    },
    /// A cylinder around the frame's second axis, plus the rounding.
    Disc {
        frame: Frame,
        radius: f64,
        half: f64,
        round: f64,
    },
}

impl Solid {
    /// Signed distance, negative inside; exact to first order near the surface.
    pub(super) fn distance(&self, p: Vec3) -> f64 {
        match self {
            Self::Cone { a, b, ra, rb } => cone(p, *a, *b, *ra, *rb),
            Self::Tube { points, ra, rb } => {
                let step = (rb - ra) / (points.len() - 1) as f64;
                let hulls = points.windows(2).enumerate().map(|(i, ends)| {
                    let r = ra + step * i as f64;
                    cone(p, ends[0], ends[1], r, r + step)
                });
                hulls.fold(f64::INFINITY, f64::min)
            }
            Self::Ellipsoid { frame, radii } => ellipsoid(frame.local(p), *radii),
            Self::Block { frame, half, round } => {
                let q = frame.local(p);
                let d = [0, 1, 2].map(|k| q[k].abs() - half[k]);
                let inside = d[0].max(d[1]).max(d[2]).min(0.0);
                inside + norm(d.map(|x| x.max(0.0))) - round
            }
            Self::Plate {
                frame,
                outline,
                half,
                round,
            } => {
                let q = frame.local(p);
                slab(polygon([q[0], q[1]], outline), q[2].abs() - half) - round
            }
            Self::Shell {
                frame,
                profile,
                round,
            } => {
                let q = frame.local(p);
                let r = (q[0] * q[0] + q[2] * q[2]).sqrt();
                polyline([r, q[1]], profile) - round
            }
            Self::Disc {
                frame,
                radius,
                half,
                round,
            } => {
                let q = frame.local(p);
                let r = (q[0] * q[0] + q[2] * q[2]).sqrt();
                slab(r - radius, q[1].abs() - half) - round
            }
        }
    }

    /// A point inside.
    pub(super) fn inside(&self) -> Vec3 {
        match self {
            Self::Cone { a, .. } => *a,
            Self::Tube { points, .. } => points[0],
            Self::Ellipsoid { frame, .. }
            | Self::Block { frame, .. }
            | Self::Disc { frame, .. } => frame.origin,
            Self::Plate { frame, outline, .. } => frame.world([outline[0][0], outline[0][1], 0.0]),
            Self::Shell { frame, profile, .. } => frame.world([profile[0][0], profile[0][1], 0.0]),
        }
    }

    /// Radius of the largest ball that fits into its thinnest part.
    pub(super) fn thickness(&self) -> f64 {
        match self {
            Self::Cone { ra, rb, .. } | Self::Tube { ra, rb, .. } => ra.min(*rb),
            Self::Ellipsoid { radii, .. } => radii[0].min(radii[1]).min(radii[2]),
            Self::Block { half, round, .. } => half[0].min(half[1]).min(half[2]) + round,
            Self::Plate { half, round, .. } => half + round,
            Self::Disc {
                radius,
                half,
                round,
                ..
            } => half.min(*radius) + round,
            Self::Shell { round, .. } => *round,
        }
    }

    /// A ball that contains it.
    pub(super) fn ball(&self) -> Ball {
        match self {
            Self::Cone { a, b, ra, rb } => Ball::around(&[*a, *b], ra.max(*rb)),
            Self::Tube { points, ra, rb } => Ball::around(points, ra.max(*rb)),
            Self::Ellipsoid { frame, radii } => Ball {
                centre: frame.origin,
                radius: radii[0].max(radii[1]).max(radii[2]),
            },
            Self::Block { frame, half, round } => Ball {
                centre: frame.origin,
                radius: norm(*half) + round,
            },
            Self::Plate {
                frame,
                outline,
                half,
                round,
            } => {
                let points: Vec<Vec3> = outline
                    .iter()
                    .map(|[x, y]| frame.world([*x, *y, 0.0]))
                    .collect();
                Ball::around(&points, half + round)
            }
            Self::Shell {
                frame,
                profile,
                round,
            } => {
                let rims = profile
                    .iter()
                    .flat_map(|[r, y]| [[-r, *y, 0.0], [*r, *y, 0.0]]);
                let points: Vec<Vec3> = rims.map(|rim| frame.world(rim)).collect();
                Ball::around(&points, *round)
            }
            Self::Disc {
                frame,
                radius,
                half,
                round,
            } => Ball {
                centre: frame.origin,
                radius: norm([*radius, *half, 0.0]) + round,
            },
        }
    }
}

/// A bound on the extent of a solid, so that distant ones need not be evaluated.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ball {
    centre: Vec3,
    radius: f64,
}

impl Ball {
    /// The ball around all points with `margin`.
    fn around(points: &[Vec3], margin: f64) -> Self {
        let bound = |pick: fn(f64, f64) -> f64, k: usize| {
            points
                .iter()
                .map(|p| p[k])
                .reduce(pick)
                .expect("invariant: solids have points")
        };
        let centre = [0, 1, 2].map(|k| (bound(f64::min, k) + bound(f64::max, k)) / 2.0);
        let far = points
            .iter()
            .map(|p| norm(sub(*p, centre)))
            .fold(0.0, f64::max);
        Self {
            centre,
            radius: far + margin,
        }
    }

    /// The ball around both.
    pub(super) fn with(self, other: Self) -> Self {
        let distance = norm(sub(other.centre, self.centre));
        if distance + other.radius <= self.radius {
            return self;
        }
        if distance + self.radius <= other.radius {
            return other;
        }
        let radius = (distance + self.radius + other.radius) / 2.0;
        let t = (radius - self.radius) / distance;
        Self {
            centre: along(self.centre, sub(other.centre, self.centre), t),
            radius,
        }
    }

    /// Lower bound on the distance of a contained solid from `p`.
    pub(super) fn distance(&self, p: Vec3) -> f64 {
        norm(sub(p, self.centre)) - self.radius
    }
}

/// Distance to the intersection of two half spaces with perpendicular boundaries.
fn slab(u: f64, v: f64) -> f64 {
    let (x, y) = (u.max(0.0), v.max(0.0));
    u.max(v).min(0.0) + (x * x + y * y).sqrt()
}

fn cone(p: Vec3, a: Vec3, b: Vec3, ra: f64, rb: f64) -> f64 {
    let axis = sub(b, a);
    let length2 = dot(axis, axis);
    let taper = ra - rb;
    let cos2 = length2 - taper * taper;
    if cos2 <= 0.0 {
        // One ball contains the other.
        return (norm(sub(p, a)) - ra).min(norm(sub(p, b)) - rb);
    }
    let pa = sub(p, a);
    let y = dot(pa, axis);
    let z = y - length2;
    let off = sub(scale(pa, length2), scale(axis, y));
    let x2 = dot(off, off);
    let y2 = y * y * length2;
    let z2 = z * z * length2;
    let k = taper.signum() * taper * taper * x2;
    if z.signum() * cos2 * z2 > k {
        (x2 + z2).sqrt() / length2 - rb
    } else if y.signum() * cos2 * y2 < k {
        (x2 + y2).sqrt() / length2 - ra
    } else {
        ((x2 * cos2 / length2).sqrt() + y * taper) / length2 - ra
    }
}

fn ellipsoid(q: Vec3, radii: Vec3) -> f64 {
    let u = [0, 1, 2].map(|k| q[k] / radii[k]);
    let v = [0, 1, 2].map(|k| u[k] / radii[k]);
    let (level, slope) = (norm(u), norm(v));
    let smallest = radii[0].min(radii[1]).min(radii[2]);
    if level < 0.5 {
        // The quotient below is undefined at the centre.
        return (level - 1.0) * smallest;
    }
    level * (level - 1.0) / slope
}

fn polygon(p: [f64; 2], outline: &[[f64; 2]]) -> f64 {
    let mut nearest = f64::INFINITY;
    let mut inside = false;
    let mut b = outline[outline.len() - 1];
    for &a in outline {
        nearest = nearest.min(segment2(p, a, b));
        if (a[1] > p[1]) != (b[1] > p[1]) {
            let t = (p[1] - a[1]) / (b[1] - a[1]);
            inside ^= p[0] < a[0] + t * (b[0] - a[0]);
        }
        b = a;
    }
    if inside {
        -nearest.sqrt()
    } else {
        nearest.sqrt()
    }
}

fn polyline(p: [f64; 2], points: &[[f64; 2]]) -> f64 {
    let squares = points.windows(2).map(|w| segment2(p, w[0], w[1]));
    squares.fold(f64::INFINITY, f64::min).sqrt()
}

/// Squared distance to a segment.
fn segment2(p: [f64; 2], a: [f64; 2], b: [f64; 2]) -> f64 {
    let e = [b[0] - a[0], b[1] - a[1]];
    let d = [p[0] - a[0], p[1] - a[1]];
    let length2 = e[0] * e[0] + e[1] * e[1];
    let t = if length2 > 0.0 {
        ((d[0] * e[0] + d[1] * e[1]) / length2).clamp(0.0, 1.0)
    } else {
        0.0
    };
    let (x, y) = (d[0] - t * e[0], d[1] - t * e[1]);
    x * x + y * y
}

#[cfg(test)]
mod tests {
    use super::Solid;
    use crate::synth::vector::{Frame, norm};

    fn solids() -> Vec<Solid> {
        let frame = Frame::at([0.1, -0.2, 0.3])
            .turned(0, 1, 20.0)
            .turned(1, 2, -50.0);
        let square = vec![[-0.4, -0.3], [0.4, -0.3], [0.4, 0.3], [-0.4, 0.3]];
        vec![
            Solid::Cone {
                a: [0.0; 3],
                b: [0.5, 0.4, 0.1],
                ra: 0.3,
                rb: 0.1,
            },
            Solid::Cone {
                a: [0.0; 3],
                b: [0.1, 0.0, 0.0],
                ra: 0.3,
                rb: 0.1,
            },
            Solid::Tube {
                points: vec![[0.0; 3], [0.4, 0.1, 0.0], [0.5, 0.5, 0.0]],
                ra: 0.2,
                rb: 0.1,
            },
            Solid::Ellipsoid {
                frame,
                radii: [0.5, 0.3, 0.4],
            },
            Solid::Block {
                frame,
                half: [0.3, 0.2, 0.1],
                round: 0.05,
            },
            Solid::Plate {
                frame,
                outline: square,
                half: 0.05,
                round: 0.05,
            },
            Solid::Shell {
                frame,
                profile: vec![[0.0, 0.0], [0.4, 0.0], [0.5, 0.5]],
                round: 0.06,
            },
            Solid::Disc {
                frame,
                radius: 0.4,
                half: 0.1,
                round: 0.02,
            },
        ]
    }

    #[test]
    fn distances_have_unit_slope_at_the_surface() {
        for solid in solids() {
            let inside = solid.inside();
            assert!(solid.distance(inside) < 0.0, "{solid:?}");
            for (k, sign) in [
                (0, 1.0),
                (0, -1.0),
                (1, 1.0),
                (1, -1.0),
                (2, 1.0),
                (2, -1.0),
            ] {
                // Bisect to the surface; a corner or the medial axis would be an unlucky direction.
                let (mut near, mut far) = (0.0, 3.0);
                let at = |t: f64| {
                    let mut p = inside;
                    p[k] += sign * t;
                    p[(k + 1) % 3] += 0.037 * t;
                    p
                };
                for _ in 0..60 {
                    let mid = (near + far) / 2.0;
                    if solid.distance(at(mid)) < 0.0 {
                        near = mid
                    } else {
                        far = mid
                    }
                }
                // Central differences; the distances are smooth except at corners.
                let step = 1e-6;
                let g = [0, 1, 2].map(|k| {
                    let (mut p, mut q) = (at(far), at(far));
                    p[k] += step;
                    q[k] -= step;
                    (solid.distance(p) - solid.distance(q)) / (2.0 * step)
                });
                let slope = norm(g);
                assert!((slope - 1.0).abs() < 1e-3, "{solid:?}: slope {slope}");
            }
        }
    }

    #[test]
    fn balls_hold_their_solids() {
        for solid in solids() {
            let ball = solid.ball();
            for i in 0..8000 {
                let p = [i % 20, i / 20 % 20, i / 400].map(|k| f64::from(k) * 0.1 - 0.95);
                assert!(
                    solid.distance(p) > 0.0 || ball.distance(p) <= 0.0,
                    "{solid:?} at {p:?}"
                );
            }
        }
    }
}
