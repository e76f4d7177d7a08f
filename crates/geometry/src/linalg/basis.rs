//! Projects many panels on each other and combines them, in few passes over memory.
//!
//! The same rows of all panels lie together (chunk-major), so one pass serves one product, whatever
//! the number of panels. The basis has its own memory mapping, in huge pages where the system has
//! them: it is read from end to end hundreds of times, and walking the page tables of small pages
//! costs a quarter of that.

use super::panel::{
    AddCombination, BURST, CHUNK, PADDING, Project, Row, SLABS, Tile, WIDTH, ZERO_TILE, add_tile,
    negated, zero_panel,
};
use memmap2::MmapMut;
use pulp::Arch;
use rayon::prelude::{IndexedParallelIterator, IntoParallelIterator, ParallelIterator};
use rayon::slice::{ParallelSlice, ParallelSliceMut};

/// Number of chunks whose panels stay in the second-level cache while they are combined.
const BATCH: usize = 16;

/// Panels with the same number of rows, stored chunk by chunk.
#[derive(Debug)]
pub struct Basis {
    memory: MmapMut,
    n_chunks: usize,
    n_panels: usize,
    capacity: usize,
    parallel: bool,
}

/// Zeroed memory for `n` rows.
fn mapped(n: usize) -> MmapMut {
    let bytes = (n * size_of::<Row>()).max(1);
    let memory = MmapMut::map_anon(bytes);
    let memory = memory.unwrap_or_else(|e| panic!("out of memory: no {bytes} bytes: {e}"));
    // Without huge pages, small ones do the same.
    #[cfg(target_os = "linux")]
    let _ = memory.advise(memmap2::Advice::HugePage);
    memory
}

impl Basis {
    /// An empty basis of panels with `n` rows, with room for `capacity` of them. `parallel`: work
    /// on slabs of rows in the rayon pool of the caller.
    pub fn new(n: usize, capacity: usize, parallel: bool) -> Self {
        let n_chunks = n.next_multiple_of(PADDING) / CHUNK;
        let capacity = capacity.max(1);
        Self {
            memory: mapped(n_chunks * capacity * CHUNK),
            n_chunks,
            n_panels: 0,
            capacity,
            parallel,
        }
    }

    /// Number of panels.
    pub fn n_panels(&self) -> usize {
        self.n_panels
    }

    /// The rows of every panel in chunk `c`, one panel after the other.
    fn chunk(&self, c: usize) -> &[Row] {
        let begin = c * self.capacity * CHUNK;
        &self.rows()[begin..begin + self.n_panels * CHUNK]
    }

    fn rows(&self) -> &[Row] {
        let n = self.n_chunks * self.capacity * CHUNK;
        &bytemuck::cast_slice(&self.memory[..n * size_of::<Row>()])[..n]
    }

    fn rows_mut(&mut self) -> &mut [Row] {
        let n = self.n_chunks * self.capacity * CHUNK;
        &mut bytemuck::cast_slice_mut(&mut self.memory[..n * size_of::<Row>()])[..n]
    }

    /// Appends a panel.
    pub fn push(&mut self, panel: &[Row]) {
        if self.n_panels == self.capacity {
            self.grow();
        }
        let (begin, stride) = (self.n_panels * CHUNK, self.capacity * CHUNK);
        let put = |(chunk, rows): (&mut [Row], &[Row])| {
            chunk[begin..begin + CHUNK].copy_from_slice(rows);
        };
        if self.parallel {
            let chunks = self.rows_mut().par_chunks_exact_mut(stride);
            chunks.zip(panel.par_chunks_exact(CHUNK)).for_each(put);
        } else {
            let chunks = self.rows_mut().chunks_exact_mut(stride);
            chunks.zip(panel.chunks_exact(CHUNK)).for_each(put);
        }
        self.n_panels += 1;
    }

    fn grow(&mut self) {
        let mut wider = Self::new(
            self.n_chunks * CHUNK,
            self.capacity * 5 / 4 + 1,
            self.parallel,
        );
        let (narrow, wide) = (self.capacity * CHUNK, wider.capacity * CHUNK);
        let chunks = self.rows().chunks_exact(narrow);
        for (from, to) in chunks.zip(wider.rows_mut().chunks_exact_mut(wide)) {
            to[..narrow].copy_from_slice(from);
        }
        wider.n_panels = self.n_panels;
        *self = wider;
    }

    /// Copies panel `j` out.
    pub fn panel(&self, j: usize) -> Vec<Row> {
        let mut out = Vec::with_capacity(self.n_chunks * CHUNK);
        self.copy_panel(j, &mut out);
        out
    }

    /// Copies panel `j` into `out`, whose contents it replaces.
    pub fn copy_panel(&self, j: usize, out: &mut Vec<Row>) {
        out.clear();
        self.rows_of(j).for_each(|rows| out.extend_from_slice(rows));
    }

    /// Row `i` of every panel.
    pub fn row(&self, i: usize) -> impl Iterator<Item = &Row> {
        let chunk = self.chunk(i / CHUNK);
        chunk[(i % CHUNK).min(chunk.len())..].iter().step_by(CHUNK)
    }

    /// The rows of panel `j`, chunk by chunk.
    pub fn rows_of(&self, j: usize) -> impl Iterator<Item = &[Row]> {
        (0..self.n_chunks).map(move |c| &self.chunk(c)[j * CHUNK..(j + 1) * CHUNK])
    }

    /// The rows of panel `j`, chunk by chunk, to change.
    pub fn rows_of_mut(&mut self, j: usize) -> impl Iterator<Item = &mut [Row]> {
        let stride = self.capacity * CHUNK;
        let chunks = self.rows_mut().chunks_exact_mut(stride);
        chunks.map(move |c| &mut c[j * CHUNK..(j + 1) * CHUNK])
    }

    /// A basis of the listed columns, each as (index in `sources`, column).
    pub fn of_columns(
        n: usize,
        parallel: bool,
        sources: &[&Self],
        columns: &[(usize, usize)],
    ) -> Self {
        let mut out = Self::new(n, columns.len().div_ceil(WIDTH), parallel);
        for group in columns.chunks(WIDTH) {
            let mut panel = zero_panel(n);
            for (to, &(source, from)) in group.iter().enumerate() {
                let rows = sources[source].rows_of(from / WIDTH).flatten();
                for (row, x) in panel.iter_mut().zip(rows) {
                    row.0[to] = x.0[from % WIDTH];
                }
            }
            out.push(&panel);
        }
        out
    }

    /// `V_jᵀ W` for every panel `j >= first`, for several `W` in one pass over memory.
    pub fn project<const N: usize>(&self, first: usize, panels: [&[Row]; N]) -> [Vec<Tile>; N] {
        let arch = Arch::new();
        let n_bursts = self.n_chunks / BURST;
        let per_slab = n_bursts.div_ceil(SLABS).max(1);
        let n_tiles = self.n_panels - first;
        let n_slabs = n_bursts.div_ceil(per_slab);
        let zeros = || std::array::from_fn(|_| vec![ZERO_TILE; n_tiles]);
        let slab = |s: usize| -> [Vec<Tile>; N] {
            let mut tiles = zeros();
            let begin = s * per_slab;
            for b in begin..(begin + per_slab).min(n_bursts) {
                let v = std::array::from_fn(|i| &self.chunk(b * BURST + i)[first * CHUNK..]);
                let w = panels.map(|p| &p[b * PADDING..(b + 1) * PADDING]);
                let tiles = &mut tiles;
                arch.dispatch(Project { v, w, tiles });
            }
            tiles
        };
        let mut total: [Vec<Tile>; N] = zeros();
        let mut add = |part: [Vec<Tile>; N]| {
            let parts = part.iter().flatten();
            for (t, p) in total.iter_mut().flatten().zip(parts) {
                add_tile(t, p);
            }
        };
        if self.parallel {
            let parts: Vec<[Vec<Tile>; N]> = (0..n_slabs).into_par_iter().map(slab).collect();
            parts.into_iter().for_each(add);
        } else {
            (0..n_slabs).for_each(|s| add(slab(s)));
        }
        total
    }

    /// `W += Σ_j V_j C_j` over the panels `j >= first`, for several `W` in one pass over memory;
    /// `tiles` holds the `C_j` of each.
    pub fn add_combination<const N: usize>(
        &self,
        first: usize,
        tiles: [&[Tile]; N],
        panels: [&mut [Row]; N],
    ) {
        let arch = Arch::new();
        let body = |(c, w): (usize, [&mut [Row]; N])| {
            let v = &self.chunk(c)[first * CHUNK..];
            for (tiles, w) in tiles.into_iter().zip(w) {
                arch.dispatch(AddCombination { v, tiles, w });
            }
        };
        let mut rows = panels.map(|p| p.chunks_exact_mut(CHUNK));
        let chunks = (0..self.n_chunks).map(|c| {
            let w = rows.each_mut().map(Iterator::next);
            (
                c,
                w.map(|w| w.expect("invariant: every panel has the basis' chunks")),
            )
        });
        if self.parallel {
            let chunks: Vec<_> = chunks.collect();
            chunks.into_par_iter().for_each(body);
        } else {
            chunks.for_each(body);
        }
    }

    /// Removes from the panels their components along all panels of the basis from `first` on;
    /// returns `V_jᵀ W` for each.
    pub fn remove<const N: usize>(&self, first: usize, panels: [&mut [Row]; N]) -> [Vec<Tile>; N] {
        let tiles = self.project(first, panels.each_ref().map(|p| &**p));
        let negative = tiles
            .each_ref()
            .map(|t| t.iter().map(negated).collect::<Vec<Tile>>());
        self.add_combination(first, negative.each_ref().map(Vec::as_slice), panels);
        tiles
    }

    /// Replaces the panels by `X_p = Σ_j V_j C_pj`, where `coefficients[p][j]` is `C_pj`; there are
    /// at most as many new panels as old ones. It works in place, so that no memory is touched for
    /// the first time.
    pub fn transform(&mut self, coefficients: &[Vec<Tile>]) {
        let arch = Arch::new();
        let (n_in, n_out) = (self.n_panels, coefficients.len());
        assert!(n_out <= n_in, "invariant: a transform does not add panels");
        let stride = self.capacity * CHUNK;
        let body = |batch: &mut [Row]| {
            let mut x = vec![Row::ZERO; batch.len() / stride * n_out * CHUNK];
            for (p, tiles) in coefficients.iter().enumerate() {
                let out = x.chunks_exact_mut(n_out * CHUNK);
                for (v, x) in batch.chunks_exact(stride).zip(out) {
                    let w = &mut x[p * CHUNK..(p + 1) * CHUNK];
                    let v = &v[..n_in * CHUNK];
                    arch.dispatch(AddCombination { v, tiles, w });
                }
            }
            let out = x.chunks_exact(n_out * CHUNK);
            for (v, x) in batch.chunks_exact_mut(stride).zip(out) {
                v[..x.len()].copy_from_slice(x);
            }
        };
        let parallel = self.parallel;
        let batches = self.rows_mut();
        match (n_out, parallel) {
            (0, _) => {}
            (_, true) => batches.par_chunks_mut(BATCH * stride).for_each(body),
            (_, false) => batches.chunks_mut(BATCH * stride).for_each(body),
        }
        self.n_panels = n_out;
    }
}
