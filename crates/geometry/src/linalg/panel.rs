//! Multiplies tall matrices with 8 columns at the speed of a matrix product.
//!
//! A *panel* is `n` rows of [`WIDTH`] numbers, row-major, padded with zero rows to a multiple of
//! [`PADDING`]; a [`Row`] is one line of the cache.

// Small matrices and register tiles read best with their indices.
#![allow(clippy::needless_range_loop)]

use bytemuck::{Pod, Zeroable};
use pulp::{Arch, Simd, WithSimd};
use rayon::iter::{IndexedParallelIterator, ParallelIterator};
use rayon::slice::{ParallelSlice, ParallelSliceMut};

/// Columns of a panel.
pub const WIDTH: usize = 8;

/// Rows of a chunk: as many as a kernel holds in registers, so that the same rows of hundreds of
/// panels are one short stream of memory.
pub const CHUNK: usize = 6;

/// Chunks that a projection takes together, from as many streams: an accumulator is loaded and
/// stored once for all of them.
pub(super) const BURST: usize = 4;

/// Panels are padded with zero rows to a multiple of this.
pub const PADDING: usize = CHUNK * BURST;

/// Independent partial sums of a reduction over rows, whose bounds depend on the number of rows
/// alone: the same bits come out for any number of threads.
pub(super) const SLABS: usize = 8;

/// Rows that a thread takes at a time.
const PIECE: usize = 64 * PADDING;

/// One row of a panel.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Row(pub [f64; WIDTH]);

impl Row {
    /// All zero.
    pub const ZERO: Row = Row([0.0; WIDTH]);
}

/// An `(8, 8)` matrix, row-major.
pub type Tile = [Row; WIDTH];

/// The zero tile.
pub const ZERO_TILE: Tile = [Row::ZERO; WIDTH];

/// A panel of zeros with `n` rows and padding.
///
/// ```
/// use coseg_geometry::linalg::panel::{PADDING, zero_panel};
///
/// assert_eq!(zero_panel(3).len(), PADDING);
/// assert_eq!(zero_panel(PADDING + 1).len(), 2 * PADDING);
/// ```
pub fn zero_panel(n: usize) -> Vec<Row> {
    vec![Row::ZERO; n.next_multiple_of(PADDING)]
}

pub(super) fn add_tile(total: &mut Tile, part: &Tile) {
    for (t, p) in total.iter_mut().zip(part) {
        for (x, y) in t.0.iter_mut().zip(&p.0) {
            *x += y;
        }
    }
}

/// `-C`.
pub fn negated(tile: &Tile) -> Tile {
    tile.map(|row| Row(row.0.map(|x| -x)))
}

/// `A B`.
pub fn tile_product(a: &Tile, b: &Tile) -> Tile {
    let mut c = ZERO_TILE;
    for (ci, ai) in c.iter_mut().zip(a) {
        for (&x, bk) in ai.0.iter().zip(b) {
            for (y, &z) in ci.0.iter_mut().zip(&bk.0) {
                *y += x * z;
            }
        }
    }
    c
}

/// `VᵀW` of two panels with equally many rows. `parallel`: slabs of rows are shared among the
/// caller's rayon pool, with the same bits.
///
/// ```
/// use coseg_geometry::linalg::panel::{Row, gram, zero_panel};
///
/// let mut v = zero_panel(3);
/// v[..3].fill(Row([2.0; 8]));
/// assert_eq!(gram(&v, &v, false)[5].0[7], 3.0 * 4.0);
/// ```
pub fn gram(v: &[Row], w: &[Row], parallel: bool) -> Tile {
    let arch = Arch::new();
    let per_slab = (v.len() / PADDING).div_ceil(SLABS).max(1) * PADDING;
    let slab = |(vs, ws): (&[Row], &[Row])| {
        let mut part = [vec![ZERO_TILE]];
        for (v, w) in vs.chunks_exact(PADDING).zip(ws.chunks_exact(PADDING)) {
            let v = std::array::from_fn(|i| &v[i * CHUNK..(i + 1) * CHUNK]);
            let tiles = &mut part;
            arch.dispatch(Project { v, w: [w], tiles });
        }
        part[0][0]
    };
    let mut total = ZERO_TILE;
    let mut add = |part: Tile| add_tile(&mut total, &part);
    if parallel {
        let slabs = v.par_chunks(per_slab).zip(w.par_chunks(per_slab));
        let parts: Vec<Tile> = slabs.map(slab).collect();
        parts.into_iter().for_each(add);
    } else {
        let slabs = v.chunks(per_slab).zip(w.chunks(per_slab));
        slabs.for_each(|s| add(slab(s)));
    }
    total
}

/// `W += V C`.
pub fn add_product(v: &[Row], tile: &Tile, w: &mut [Row], parallel: bool) {
    let arch = Arch::new();
    let tiles = std::slice::from_ref(tile);
    let body = |(v, w): (&[Row], &mut [Row])| {
        for (v, w) in v.chunks_exact(CHUNK).zip(w.chunks_exact_mut(CHUNK)) {
            arch.dispatch(AddCombination { v, tiles, w });
        }
    };
    if parallel {
        let pieces = v.par_chunks(PIECE).zip(w.par_chunks_mut(PIECE));
        pieces.for_each(body);
    } else {
        body((v, w));
    }
}

/// `W ← W C`.
pub fn multiply_in_place(panel: &mut [Row], tile: &Tile, parallel: bool) {
    let arch = Arch::new();
    let tiles = std::slice::from_ref(tile);
    let body = |w: &mut [Row]| {
        let mut copy = [Row::ZERO; CHUNK];
        for w in w.chunks_exact_mut(CHUNK) {
            copy.copy_from_slice(w);
            w.fill(Row::ZERO);
            let v = &copy;
            arch.dispatch(AddCombination { v, tiles, w });
        }
    };
    if parallel {
        panel.par_chunks_mut(PIECE).for_each(body);
    } else {
        body(panel);
    }
}

/// Whether two vectors fit into a row; otherwise (8 numbers in a vector) a row is one vector.
#[inline(always)]
pub(super) fn paired<S: Simd>() -> bool {
    2 * S::F64_LANES <= WIDTH
}

/// Vectors `V h..V h + V` of a row.
#[inline(always)]
pub(super) fn load<S: Simd, const V: usize>(row: &[f64], h: usize) -> [S::f64s; V] {
    let (vectors, _) = S::as_simd_f64s(row);
    std::array::from_fn(|v| vectors[V * h + v])
}

/// Replaces vectors `V h..V h + V` of a row.
#[inline(always)]
pub(super) fn store<S: Simd, const V: usize>(row: &mut [f64], h: usize, x: [S::f64s; V]) {
    let (vectors, _) = S::as_mut_simd_f64s(row);
    vectors[V * h..V * h + V].copy_from_slice(&x);
}

/// `a + l b`.
#[inline(always)]
pub(super) fn add_scaled<S: Simd, const V: usize>(
    simd: S,
    a: [S::f64s; V],
    l: f64,
    b: [S::f64s; V],
) -> [S::f64s; V] {
    let l = simd.splat_f64s(l);
    std::array::from_fn(|v| simd.mul_add_e_f64s(l, b[v], a[v]))
}

/// `C_j += V_jᵀ W` for a burst of chunks of every panel.
pub(super) struct Project<'a, const N: usize> {
    pub(super) v: [&'a [Row]; BURST],
    pub(super) w: [&'a [Row]; N],
    pub(super) tiles: &'a mut [Vec<Tile>; N],
}

impl<const N: usize> WithSimd for Project<'_, N> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let v: [&[[Row; CHUNK]]; BURST] = self.v.map(|v| v.as_chunks().0);
        let w: [&[[Row; CHUNK]]; N] = self.w.map(|w| w.as_chunks().0);
        for j in 0..v[0].len() {
            let v = v.map(|v| &v[j]);
            for (tiles, w) in self.tiles.iter_mut().zip(w) {
                let tile = &mut tiles[j];
                if paired::<S>() {
                    for h in 0..WIDTH / (2 * S::F64_LANES) {
                        project_columns::<S, 2, 0, 4>(simd, v, w, h, tile);
                        project_columns::<S, 2, 4, 4>(simd, v, w, h, tile);
                    }
                } else {
                    project_columns::<S, 1, 0, WIDTH>(simd, v, w, 0, tile);
                }
            }
        }
    }
}

/// Rows `Q..Q + B` of `C += VᵀW`, in vectors `X h..X h + X` of columns.
#[inline(always)]
fn project_columns<S: Simd, const X: usize, const Q: usize, const B: usize>(
    simd: S,
    v: [&[Row; CHUNK]; BURST],
    w: &[[Row; CHUNK]],
    h: usize,
    tile: &mut Tile,
) {
    let mut acc = [[simd.splat_f64s(0.0); X]; B];
    for (v, w) in v.into_iter().zip(w) {
        for (vr, wr) in v.iter().zip(w) {
            let w = load::<S, X>(&wr.0, h);
            for b in 0..B {
                acc[b] = add_scaled(simd, acc[b], vr.0[Q + b], w);
            }
        }
    }
    for (row, a) in tile[Q..Q + B].iter_mut().zip(acc) {
        let c = load::<S, X>(&row.0, h);
        store::<S, X>(
            &mut row.0,
            h,
            std::array::from_fn(|x| simd.add_f64s(c[x], a[x])),
        );
    }
}

/// `W += Σ_j V_j C_j` for one chunk.
pub(super) struct AddCombination<'a> {
    pub(super) v: &'a [Row],
    pub(super) tiles: &'a [Tile],
    pub(super) w: &'a mut [Row],
}

impl WithSimd for AddCombination<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let w = self.w.first_chunk_mut().expect("invariant: w is one chunk");
        if paired::<S>() {
            for h in 0..WIDTH / (2 * S::F64_LANES) {
                add_rows::<S, 2>(simd, self.v, self.tiles, h, w);
            }
        } else {
            add_rows::<S, 1>(simd, self.v, self.tiles, 0, w);
        }
    }
}

/// `W += Σ_j V_j C_j`, in vectors `X h..X h + X` of columns: 6 rows of two vectors are 12
/// accumulators, which with the vectors they are made from fit into 16 registers and hide the
/// latency of the multiply-add.
#[inline(always)]
fn add_rows<S: Simd, const X: usize>(
    simd: S,
    v: &[Row],
    tiles: &[Tile],
    h: usize,
    w: &mut [Row; CHUNK],
) {
    let mut acc: [[S::f64s; X]; CHUNK] = std::array::from_fn(|b| load::<S, X>(&w[b].0, h));
    for (v, tile) in v.as_chunks::<CHUNK>().0.iter().zip(tiles) {
        for q in 0..WIDTH {
            let c = load::<S, X>(&tile[q].0, h);
            for b in 0..CHUNK {
                acc[b] = add_scaled(simd, acc[b], v[b].0[q], c);
            }
        }
    }
    for (row, a) in w.iter_mut().zip(acc) {
        store::<S, X>(&mut row.0, h, a);
    }
}
