//! Provides points, frames and angles for generated shapes, in arithmetic that gives the same bits
//! on every machine.
//!
//! Only `+ - * /` and `sqrt` are used, which IEEE 754 rounds correctly. Sine and cosine are
//! polynomials here, because their last bit depends on the platform's mathematics library.

/// A point or a direction.
pub(super) type Vec3 = [f64; 3];

pub(super) fn add(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(super) fn sub(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(super) fn scale(a: Vec3, s: f64) -> Vec3 {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// `a + s·b`.
pub(super) fn along(a: Vec3, b: Vec3, s: f64) -> Vec3 {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

pub(super) fn mix(a: Vec3, b: Vec3, t: f64) -> Vec3 {
    along(scale(a, 1.0 - t), b, t)
}

pub(super) fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

pub(super) fn norm(a: Vec3) -> f64 {
    dot(a, a).sqrt()
}

/// The unit vector along `a`; zero stays zero.
pub(super) fn unit(a: Vec3) -> Vec3 {
    let n = norm(a);
    if n > 0.0 { scale(a, 1.0 / n) } else { a }
}

/// Sine and cosine of an angle in degrees, within 1e-15; exact at multiples of 90.
pub(super) fn sin_cos(degrees: f64) -> (f64, f64) {
    let quarter = (degrees / 90.0).round();
    let x = (degrees - 90.0 * quarter) * (std::f64::consts::PI / 180.0);
    let y = x * x;
    // Taylor polynomials by Horner's rule; |x| <= pi/4, so degree 17 leaves less than 1e-17.
    let sin = x
        * (1..=8)
            .rev()
            .fold(1.0, |s, k| 1.0 - s * y / f64::from(2 * k * (2 * k + 1)));
    let cos = (1..=9)
        .rev()
        .fold(1.0, |s, k| 1.0 - s * y / f64::from(2 * k * (2 * k - 1)));
    match quarter.rem_euclid(4.0) as u8 {
        0 => (sin, cos),
        1 => (cos, -sin),
        2 => (-sin, -cos),
        _ => (-cos, sin),
    }
}

/// The unit vector in the plane of `a` and `b` that is `degrees` from `a` towards `b`; both must be
/// orthonormal.
pub(super) fn turn(a: Vec3, b: Vec3, degrees: f64) -> Vec3 {
    let (s, c) = sin_cos(degrees);
    along(scale(a, c), b, s)
}

/// A right-handed orthonormal frame at a point.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame {
    pub(super) origin: Vec3,
    pub(super) axes: [Vec3; 3],
}

impl Frame {
    /// The axes of the world at `origin`.
    pub(super) fn at(origin: Vec3) -> Self {
        Self {
            origin,
            axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        }
    }

    /// The frame at `origin` whose second axis is `y`, and whose third axis is as near to `z` as
    /// possible.
    pub(super) fn facing(origin: Vec3, y: Vec3, z: Vec3) -> Self {
        let y = unit(y);
        let x = unit(cross(y, z));
        Self {
            origin,
            axes: [x, y, cross(x, y)],
        }
    }

    /// The frame, turned in the plane of its axes `i` and `j`, from `i` towards `j`.
    pub(super) fn turned(mut self, i: usize, j: usize, degrees: f64) -> Self {
        let (a, b) = (self.axes[i], self.axes[j]);
        self.axes[i] = turn(a, b, degrees);
        self.axes[j] = turn(b, scale(a, -1.0), degrees);
        self
    }

    pub(super) fn local(&self, p: Vec3) -> Vec3 {
        let d = sub(p, self.origin);
        self.axes.map(|axis| dot(d, axis))
    }

    pub(super) fn world(&self, p: Vec3) -> Vec3 {
        let q = along(self.origin, self.axes[0], p[0]);
        along(along(q, self.axes[1], p[1]), self.axes[2], p[2])
    }
}

/// Points on the cubic Bézier curve of four control points, ends included.
pub(super) fn bezier(control: [Vec3; 4], n_segments: usize) -> Vec<Vec3> {
    (0..=n_segments)
        .map(|i| {
            let t = i as f64 / n_segments as f64;
            let [a, b, c, d] = control;
            let (p, q, r) = (mix(a, b, t), mix(b, c, t), mix(c, d, t));
            mix(mix(p, q, t), mix(q, r, t), t)
        })
        .collect()
}

/// A closed Catmull-Rom curve through points of the plane, `n` segments between neighbours.
pub(super) fn closed_curve(points: &[[f64; 2]], n: usize) -> Vec<[f64; 2]> {
    let len = points.len();
    let at = |i: usize| points[i % len];
    let mut out = Vec::with_capacity(len * n);
    for i in 0..len {
        let (a, b, c, d) = (at(i + len - 1), at(i), at(i + 1), at(i + 2));
        for s in 0..n {
            out.push(catmull_rom([a, b, c, d], s as f64 / n as f64));
        }
    }
    out
}

/// An open Catmull-Rom curve through points of the plane, `n` segments between neighbours.
pub(super) fn open_curve(points: &[[f64; 2]], n: usize) -> Vec<[f64; 2]> {
    let last = points.len() - 1;
    let mut out = Vec::with_capacity(last * n + 1);
    for i in 0..last {
        let (b, c) = (points[i], points[i + 1]);
        let a = if i > 0 { points[i - 1] } else { b };
        let d = if i + 2 <= last { points[i + 2] } else { c };
        for s in 0..n {
            out.push(catmull_rom([a, b, c, d], s as f64 / n as f64));
        }
    }
    out.push(points[last]);
    out
}

fn catmull_rom([a, b, c, d]: [[f64; 2]; 4], t: f64) -> [f64; 2] {
    [0, 1].map(|k| {
        let (a, b, c, d) = (a[k], b[k], c[k], d[k]);
        let cubic = 3.0 * (b - c) + d - a;
        let quadratic = 2.0 * a - 5.0 * b + 4.0 * c - d;
        b + 0.5 * t * (c - a + t * (quadratic + t * cubic))
    })
}

#[cfg(test)]
mod tests {
    use super::{Frame, cross, dot, sin_cos};

    #[test]
    fn sine_and_cosine_agree_with_the_library() {
        for i in -4000..4000 {
            let degrees = f64::from(i) * 0.37;
            let (s, c) = sin_cos(degrees);
            let x = degrees.to_radians();
            // The library's argument is rounded to one part in 2^53 of up to 26 radians.
            assert!(
                (s - x.sin()).abs() < 1e-14 && (c - x.cos()).abs() < 1e-14,
                "{degrees}"
            );
        }
        assert_eq!(sin_cos(90.0), (1.0, 0.0));
        assert_eq!(sin_cos(180.0), (0.0, -1.0));
    }

    #[test]
    fn frames_stay_right_handed() {
        let f =
            Frame::facing([1.0, 2.0, 3.0], [0.3, 1.0, -0.2], [0.0, 0.5, 1.0]).turned(0, 2, 35.0);
        let [x, y, z] = f.axes;
        assert!((dot(cross(x, y), z) - 1.0).abs() < 1e-12);
        let p = [0.3, -0.7, 1.1];
        let q = f.local(f.world(p));
        assert!((0..3).all(|k| (p[k] - q[k]).abs() < 1e-12));
    }
}
