//! Tall matrices 16 columns wide become projections and combinations of each other at the speed of
//! a matrix product.
//!
//! A *panel* is `n` rows of [`WIDTH`] numbers, row-major, padded with zero rows to a multiple of
//! [`CHUNK`]. A [`Basis`] holds many panels so that the same rows of all of them lie together
//! (chunk-major): one pass over memory then serves one product, whatever the number of panels.
//!
//! Reductions over rows are cut into at most [`SLABS`] slabs whose bounds depend on `n` alone and
//! are added up in order: the same bits come out for any number of threads.

// Small matrices and register tiles read best with their indices.
#![allow(clippy::needless_range_loop)]

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::{
    IndexedParallelIterator, IntoParallelIterator, IntoParallelRefMutIterator, ParallelIterator,
};
use rayon::slice::ParallelSliceMut;

/// Columns of a panel.
pub const WIDTH: usize = 16;

/// Rows of a chunk: a multiple of the 6 rows a kernel holds in registers; two chunks of 12 KiB fit
/// into the first-level cache.
pub const CHUNK: usize = 96;

/// Independent partial sums of a reduction over rows.
const SLABS: usize = 8;

/// Chunks that threads share out between them at a time.
const BATCH: usize = 16;

/// One row of a panel.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row(pub [f64; WIDTH]);

impl Row {
    /// All zero.
    pub const ZERO: Row = Row([0.0; WIDTH]);
}

/// A `(16, 16)` matrix, row-major.
pub type Tile = [Row; WIDTH];

/// The zero tile.
pub const ZERO_TILE: Tile = [Row::ZERO; WIDTH];

/// A panel of zeros with `n` rows and padding.
pub fn zero_panel(n: usize) -> Vec<Row> {
    vec![Row::ZERO; n.div_ceil(CHUNK) * CHUNK]
}

/// Panels with the same number of rows, stored chunk by chunk.
#[derive(Debug, Clone)]
pub struct Basis {
    chunks: Vec<Vec<Row>>,
    n_panels: usize,
    parallel: bool,
}

impl Basis {
    /// An empty basis of panels with `n` rows, with room for `capacity` of them. `parallel`: work
    /// on slabs of rows in the rayon pool of the caller.
    pub fn new(n: usize, capacity: usize, parallel: bool) -> Self {
        let chunks = (0..n.div_ceil(CHUNK))
            .map(|_| Vec::with_capacity(capacity * CHUNK))
            .collect();
        Self {
            chunks,
            n_panels: 0,
            parallel,
        }
    }

    /// Number of panels.
    pub fn n_panels(&self) -> usize {
        self.n_panels
    }

    /// Appends a panel.
    pub fn push(&mut self, panel: &[Row]) {
        for (chunk, rows) in self.chunks.iter_mut().zip(panel.chunks_exact(CHUNK)) {
            chunk.extend_from_slice(rows);
        }
        self.n_panels += 1;
    }

    /// Copies panel `j` out.
    pub fn panel(&self, j: usize) -> Vec<Row> {
        let mut out = Vec::with_capacity(self.chunks.len() * CHUNK);
        for chunk in &self.chunks {
            out.extend_from_slice(&chunk[j * CHUNK..(j + 1) * CHUNK]);
        }
        out
    }

    /// `V_jᵀ W` for every panel `j >= first`.
    pub fn project(&self, first: usize, panel: &[Row]) -> Vec<Tile> {
        let arch = Arch::new();
        let per_slab = self.chunks.len().div_ceil(SLABS).max(1);
        let n_tiles = self.n_panels - first;
        let n_slabs = self.chunks.len().div_ceil(per_slab);
        let slab = |s: usize| {
            let mut tiles = vec![ZERO_TILE; n_tiles];
            let begin = s * per_slab;
            let end = (begin + per_slab).min(self.chunks.len());
            for c in begin..end {
                let v = &self.chunks[c][first * CHUNK..self.n_panels * CHUNK];
                let w = &panel[c * CHUNK..(c + 1) * CHUNK];
                arch.dispatch(Project {
                    v,
                    w,
                    tiles: &mut tiles,
                });
            }
            tiles
        };
        let mut total = vec![ZERO_TILE; n_tiles];
        let mut add = |part: Vec<Tile>| {
            for (t, p) in total.iter_mut().zip(&part) {
                add_tile(t, p);
            }
        };
        if self.parallel {
            let parts: Vec<Vec<Tile>> = (0..n_slabs).into_par_iter().map(slab).collect();
            parts.into_iter().for_each(add);
        } else {
            (0..n_slabs).for_each(|s| add(slab(s)));
        }
        total
    }

    /// `W += Σ_j V_j C_j` over the panels `j >= first`; `tiles` holds the `C_j`.
    pub fn add_combination(&self, first: usize, tiles: &[Tile], panel: &mut [Row]) {
        let arch = Arch::new();
        let body = |(c, w): (usize, &mut [Row])| {
            let v = &self.chunks[c][first * CHUNK..self.n_panels * CHUNK];
            arch.dispatch(AddCombination { v, tiles, w });
        };
        if self.parallel {
            panel.par_chunks_exact_mut(CHUNK).enumerate().for_each(body);
        } else {
            panel.chunks_exact_mut(CHUNK).enumerate().for_each(body);
        }
    }

    /// Removes from `panel` its components along all panels from `first` on; returns `V_jᵀ W`.
    pub fn remove(&self, first: usize, panel: &mut [Row]) -> Vec<Tile> {
        let tiles = self.project(first, panel);
        let negative: Vec<Tile> = tiles.iter().map(negated).collect();
        self.add_combination(first, &negative, panel);
        tiles
    }

    /// New panels `X_p = Σ_j V_j C_pj`, where `coefficients[p][j]` is `C_pj`.
    pub fn combinations(&self, coefficients: &[Vec<Tile>]) -> Vec<Vec<Row>> {
        let arch = Arch::new();
        let n_out = coefficients.len();
        let n_rows = self.chunks.len() * CHUNK;
        let mut out: Vec<Vec<Row>> = (0..n_out).map(|_| Vec::with_capacity(n_rows)).collect();
        let mut scratch =
            vec![vec![Row::ZERO; n_out * CHUNK]; if self.parallel { BATCH } else { 1 }];
        let body = |(x, v): (&mut Vec<Row>, &Vec<Row>)| {
            x.fill(Row::ZERO);
            for (tiles, w) in coefficients.iter().zip(x.chunks_exact_mut(CHUNK)) {
                arch.dispatch(AddCombination {
                    v: &v[..self.n_panels * CHUNK],
                    tiles,
                    w,
                });
            }
        };
        for batch in self.chunks.chunks(scratch.len()) {
            if self.parallel {
                scratch.par_iter_mut().zip(batch).for_each(body);
            } else {
                scratch.iter_mut().zip(batch).for_each(body);
            }
            for x in &scratch[..batch.len()] {
                for (panel, rows) in out.iter_mut().zip(x.chunks_exact(CHUNK)) {
                    panel.extend_from_slice(rows);
                }
            }
        }
        out
    }
}

fn add_tile(total: &mut Tile, part: &Tile) {
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

/// `VᵀW` of two panels.
pub fn gram(v: &[Row], w: &[Row]) -> Tile {
    let arch = Arch::new();
    let per_slab = (v.len() / CHUNK).div_ceil(SLABS).max(1) * CHUNK;
    let mut total = ZERO_TILE;
    for (vs, ws) in v.chunks(per_slab).zip(w.chunks(per_slab)) {
        let mut part = [ZERO_TILE];
        for (v, w) in vs.chunks_exact(CHUNK).zip(ws.chunks_exact(CHUNK)) {
            arch.dispatch(Project {
                v,
                w,
                tiles: &mut part,
            });
        }
        add_tile(&mut total, &part[0]);
    }
    total
}

/// `W ← W C`.
pub fn multiply_in_place(panel: &mut [Row], tile: &Tile) {
    let arch = Arch::new();
    let tiles = [*tile];
    let mut copy = [Row::ZERO; CHUNK];
    for w in panel.chunks_exact_mut(CHUNK) {
        copy.copy_from_slice(w);
        w.fill(Row::ZERO);
        arch.dispatch(AddCombination {
            v: &copy,
            tiles: &tiles,
            w,
        });
    }
}

/// Rows (or columns) a kernel keeps in registers: 6 × 2 vectors are 12 accumulators, which with two
/// loads and a broadcast fit into 16 registers and hide the latency of the multiply-add.
const HELD: usize = 6;

/// Rows that a projection takes before the next columns of the same rows: a divisor of [`CHUNK`].
const BURST: usize = 24;

struct Project<'a> {
    v: &'a [Row],
    w: &'a [Row],
    tiles: &'a mut [Tile],
}

impl WithSimd for Project<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for (v, tile) in self.v.chunks_exact(CHUNK).zip(self.tiles) {
            // Few rows at a time, so that the stream from memory is spread over all passes.
            for (v, w) in v.chunks_exact(BURST).zip(self.w.chunks_exact(BURST)) {
                for h in 0..WIDTH / (2 * S::F64_LANES) {
                    project_columns::<S, 0, HELD>(simd, v, w, h, tile);
                    project_columns::<S, 6, 5>(simd, v, w, h, tile);
                    project_columns::<S, 11, 5>(simd, v, w, h, tile);
                }
            }
        }
    }
}

/// Rows `Q..Q + B` of `C += VᵀW`, in the `h`-th pair of vectors of columns.
#[inline(always)]
fn project_columns<S: Simd, const Q: usize, const B: usize>(
    simd: S,
    v: &[Row],
    w: &[Row],
    h: usize,
    tile: &mut Tile,
) {
    let mut acc = [[simd.splat_f64s(0.0); 2]; B];
    for (vr, wr) in v.iter().zip(w) {
        let (ws, _) = S::as_simd_f64s(&wr.0);
        let (w0, w1) = (ws[2 * h], ws[2 * h + 1]);
        for b in 0..B {
            let x = simd.splat_f64s(vr.0[Q + b]);
            acc[b][0] = simd.mul_add_e_f64s(x, w0, acc[b][0]);
            acc[b][1] = simd.mul_add_e_f64s(x, w1, acc[b][1]);
        }
    }
    for (row, a) in tile[Q..Q + B].iter_mut().zip(acc) {
        let (out, _) = S::as_mut_simd_f64s(&mut row.0);
        out[2 * h] = simd.add_f64s(out[2 * h], a[0]);
        out[2 * h + 1] = simd.add_f64s(out[2 * h + 1], a[1]);
    }
}

struct AddCombination<'a> {
    v: &'a [Row],
    tiles: &'a [Tile],
    w: &'a mut [Row],
}

impl WithSimd for AddCombination<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for (v, tile) in self.v.chunks_exact(CHUNK).zip(self.tiles) {
            let (v_groups, _) = v.as_chunks::<HELD>();
            let (w_groups, _) = self.w.as_chunks_mut::<HELD>();
            for (vg, wg) in v_groups.iter().zip(w_groups) {
                for h in 0..WIDTH / (2 * S::F64_LANES) {
                    add_rows(simd, vg, tile, h, wg);
                }
            }
        }
    }
}

/// `W += V C` for a group of rows, in the `h`-th pair of vectors of columns.
#[inline(always)]
fn add_rows<S: Simd>(simd: S, v: &[Row; HELD], tile: &Tile, h: usize, w: &mut [Row; HELD]) {
    let mut acc = [[simd.splat_f64s(0.0); 2]; HELD];
    for (a, row) in acc.iter_mut().zip(w.iter()) {
        let (ws, _) = S::as_simd_f64s(&row.0);
        *a = [ws[2 * h], ws[2 * h + 1]];
    }
    for q in 0..WIDTH {
        let (cs, _) = S::as_simd_f64s(&tile[q].0);
        let (c0, c1) = (cs[2 * h], cs[2 * h + 1]);
        for i in 0..HELD {
            let x = simd.splat_f64s(v[i].0[q]);
            acc[i][0] = simd.mul_add_e_f64s(x, c0, acc[i][0]);
            acc[i][1] = simd.mul_add_e_f64s(x, c1, acc[i][1]);
        }
    }
    for (a, row) in acc.iter().zip(w.iter_mut()) {
        let (ws, _) = S::as_mut_simd_f64s(&mut row.0);
        ws[2 * h] = a[0];
        ws[2 * h + 1] = a[1];
    }
}
