//! Draws triangles as a shaded picture with a depth buffer, seen from the front, a little from
//! above and from the side.

use super::canvas::Canvas;

/// Samples of a pixel along each side, averaged.
const SAMPLES: usize = 2;
/// Share of the square that a shape fills.
const FILL: f64 = 0.96;
/// Turn about the vertical, and tilt towards the viewer, in radians.
const TURN: f64 = 0.6;
const TILT: f64 = 0.35;
/// Direction of the light (right, up, towards the viewer), and the share of ambient light.
const LIGHT: [f64; 3] = [0.35, 0.55, 0.76];
const AMBIENT: f64 = 0.45;

type Point = [f64; 3];

/// The orientation of a view: rows are right, up, towards the viewer.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct View {
    rows: [Point; 3],
    centre: [f64; 2],
    size: f64,
}

fn dot(a: Point, b: Point) -> f64 {
    (0..3).map(|i| a[i] * b[i]).sum()
}

fn cross(a: Point, b: Point) -> Point {
    [0, 1, 2].map(|i| a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3])
}

fn unit(a: Point) -> Point {
    let length = dot(a, a).sqrt().max(1e-300);
    a.map(|x| x / length)
}

impl View {
    /// With `up`, that axis is vertical. Otherwise the bounding box decides: its middle side is
    /// vertical, its longest horizontal.
    pub(super) fn new(vertices: &[Point], up: Option<Point>) -> Self {
        let side = |axis: usize| {
            let along = vertices.iter().map(|v| v[axis]);
            let (low, high) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| {
                (l.min(x), h.max(x))
            });
            high - low
        };
        let mut axes = [0, 1, 2];
        axes.sort_by(|a, b| side(*b).total_cmp(&side(*a)).then(a.cmp(b)));
        let base = |axis: usize| [0, 1, 2].map(|i| f64::from(u8::from(i == axis)));
        let up = up.unwrap_or_else(|| base(axes[1]));
        // The longest side other than the vertical one is horizontal.
        let across = axes.into_iter().map(base).find(|a| dot(*a, up).abs() < 0.5);
        let right = across.unwrap_or_else(|| base((axes[0] + 1) % 3));
        let front = unit(cross(right, up));
        let (sin, cos) = TURN.sin_cos();
        let turned = [0, 1, 2].map(|i| cos * right[i] + sin * front[i]);
        let front = unit(cross(turned, up));
        let (sin, cos) = TILT.sin_cos();
        let towards = [0, 1, 2].map(|i| cos * front[i] + sin * up[i]);
        let upwards = [0, 1, 2].map(|i| cos * up[i] - sin * front[i]);
        let rows = [turned, upwards, towards];
        let seen: Vec<Point> = vertices.iter().map(|v| rows.map(|r| dot(r, *v))).collect();
        let range = |axis: usize| {
            let along = seen.iter().map(|v| v[axis]);
            along.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| {
                (l.min(x), h.max(x))
            })
        };
        let (x, y) = (range(0), range(1));
        Self {
            rows,
            centre: [(x.0 + x.1) / 2.0, (y.0 + y.1) / 2.0],
            size: (x.1 - x.0).max(y.1 - y.0).max(1e-300),
        }
    }

    /// Draws triangles, each of one colour, to a square of `size` pixels.
    pub(super) fn draw(
        &self,
        size: usize,
        triangles: impl Iterator<Item = ([Point; 3], [u8; 3])>,
    ) -> Canvas {
        let n = size * SAMPLES;
        let mut depth = vec![f64::NEG_INFINITY; n * n];
        let mut pixels = vec![[255u8; 3]; n * n];
        let scale = FILL * n as f64 / self.size;
        let middle = n as f64 / 2.0;
        for (corners, colour) in triangles {
            let seen = corners.map(|c| self.rows.map(|r| dot(r, c)));
            let normal = unit(cross(
                [0, 1, 2].map(|i| seen[1][i] - seen[0][i]),
                [0, 1, 2].map(|i| seen[2][i] - seen[0][i]),
            ));
            // Light comes from both sides, since not every mesh has an outside.
            let lit = dot(normal, unit(LIGHT)).abs();
            let shade = AMBIENT + (1.0 - AMBIENT) * lit;
            let colour = colour.map(|c| (f64::from(c) * shade).round() as u8);
            let on = seen.map(|p| {
                [
                    middle + (p[0] - self.centre[0]) * scale,
                    middle - (p[1] - self.centre[1]) * scale,
                    p[2],
                ]
            });
            for (at, z) in covered(&on, n) {
                if z > depth[at] {
                    depth[at] = z;
                    pixels[at] = colour;
                }
            }
        }
        let mean = |p: usize| {
            let (x, y) = (p % size * SAMPLES, p / size * SAMPLES);
            let samples =
                (0..SAMPLES * SAMPLES).map(|s| pixels[(y + s / SAMPLES) * n + x + s % SAMPLES]);
            let mut sum = [0u32; 3];
            for sample in samples {
                (0..3).for_each(|c| sum[c] += u32::from(sample[c]));
            }
            sum.map(|s| (s / (SAMPLES * SAMPLES) as u32) as u8)
        };
        Canvas::of_pixels(size, (0..size * size).map(mean).collect())
    }
}

/// The samples inside a triangle, with their depth.
fn covered(on: &[Point; 3], n: usize) -> impl Iterator<Item = (usize, f64)> {
    let [a, b, c] = *on;
    let area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
    let range = |axis: usize| {
        let low = on.iter().map(|p| p[axis]).fold(f64::INFINITY, f64::min);
        let high = on.iter().map(|p| p[axis]).fold(f64::NEG_INFINITY, f64::max);
        // Casts saturate, so parts outside the picture are clipped.
        (low.floor().max(0.0) as usize)..(high.ceil().max(0.0) as usize).min(n)
    };
    let (columns, rows) = (range(0), range(1));
    let columns = if area == 0.0 { 0..0 } else { columns };
    rows.flat_map(move |y| columns.clone().map(move |x| (x, y)))
        .filter_map(move |(x, y)| {
            let p = [x as f64 + 0.5, y as f64 + 0.5];
            let weight = |q: Point, r: Point| {
                ((q[0] - p[0]) * (r[1] - p[1]) - (r[0] - p[0]) * (q[1] - p[1])) / area
            };
            let (u, v, w) = (weight(b, c), weight(c, a), weight(a, b));
            let inside = u >= 0.0 && v >= 0.0 && w >= 0.0;
            inside.then_some((y * n + x, u * a[2] + v * b[2] + w * c[2]))
        })
}

#[cfg(test)]
mod tests {
    use super::View;

    #[test]
    fn what_is_nearer_covers_what_is_behind() {
        let square = |z: f64| {
            let [a, b, c, d] = [[0.0, 0.0, z], [2.0, 0.0, z], [2.0, 1.0, z], [0.0, 1.0, z]];
            [[a, b, c], [a, c, d]]
        };
        let (near, far) = (square(0.1), square(-0.1));
        let all = [near, far].concat();
        let vertices: Vec<_> = all.iter().flatten().copied().collect();
        let view = View::new(&vertices, Some([0.0, 1.0, 0.0]));
        let drawn = |order: [usize; 4]| {
            let triangles = order.map(|i| (all[i], if i < 2 { [200, 0, 0] } else { [0, 0, 200] }));
            view.draw(40, triangles.into_iter())
        };
        let one = drawn([0, 1, 2, 3]);
        assert_eq!(one, drawn([3, 2, 1, 0]), "the order makes no difference");
        let mut red = one.clone();
        red.fill(0, 0, 40, 40, [9; 3]);
        assert_ne!(one, red);
    }

    #[test]
    fn nothing_and_slivers_draw_nothing() {
        let view = View::new(&[], None);
        let sliver = [[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]];
        let picture = view.draw(8, [(sliver, [0; 3])].into_iter());
        assert_eq!(picture, super::Canvas::new(8, 8));
    }
}
