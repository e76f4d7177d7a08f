//! Times the kernels of the geometry: `cargo bench -p coseg-geometry`, with a word after `--` to
//! run only those whose names contain it. One thread; the meshes are generated here.

use coseg_geometry::SpectralMesh;
use coseg_geometry::descriptors::{FaceDescriptors, face_descriptors, face_kernels};
use coseg_geometry::fmap::{EstimateOptions, point_maps, zoomout};
use coseg_geometry::linalg::maxflow::Network;
use coseg_geometry::linalg::nearest::nearest_rows;
use coseg_geometry::mesh::{self, DualGraph, TriMesh, icosphere};
use coseg_geometry::operators::{Operator, laplacian};
use coseg_geometry::segmentation::patches;
use coseg_geometry::spectrum::{Options, Spectrum};
use divan::{Bencher, counter::ItemsCount};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64;

fn main() {
    divan::main();
}

/// A sphere with a head, two arms and no symmetry, so that no eigenvalue is multiple.
fn lumpy(levels: u32, stretch: f64) -> TriMesh {
    let lumps = [
        ([0.0, 0.0, 1.0], 0.8),
        ([1.0, 0.0, 0.2], 0.5),
        ([-0.9, 0.3, 0.0], 0.4),
    ];
    let mut mesh = icosphere(levels);
    for v in &mut mesh.vertices {
        let at = *v;
        let height = |(top, height): &([f64; 3], f64)| {
            let d: f64 = (0..3).map(|i| (at[i] - top[i]).powi(2)).sum();
            height * (-6.0 * d).exp()
        };
        let grown = 1.0 + lumps.iter().map(height).sum::<f64>();
        *v = at.map(|x| x * grown);
        v[2] *= stretch;
    }
    mesh
}

fn spectral(levels: u32, stretch: f64, k: usize) -> SpectralMesh {
    let mesh = lumpy(levels, stretch);
    SpectralMesh::new(mesh, Operator::Tufted, k, &Options::default()).expect("a closed surface")
}

/// A lumpy sphere of 20,480 faces brought to the working resolution.
fn proxy() -> SpectralMesh {
    let mesh = mesh::proxy(&spectral(5, 1.0, 1).mesh, 2_500).mesh;
    SpectralMesh::new(mesh, Operator::Tufted, 100, &Options::default()).expect("a closed surface")
}

fn described(proxy: &SpectralMesh) -> FaceDescriptors {
    let (mesh, bridges) = (&proxy.mesh, &proxy.bridges);
    let kernels = face_kernels(&proxy.spectrum.eigenvalues);
    let kernels = kernels.of_matrix(&proxy.spectrum.eigenvectors);
    face_descriptors(mesh, bridges, &DualGraph::new(mesh, bridges), &kernels)
}

/// Block Lanczos with its certificate, from W and A in memory: subdivision level (4: 2,562
/// vertices, 5: 10,242) and number of pairs.
#[divan::bench(args = [(4, 100), (4, 300), (5, 100), (5, 300)], sample_count = 7, sample_size = 1)]
fn spectrum(bencher: Bencher<'_, '_>, (levels, k): (u32, usize)) {
    let operator = laplacian(&lumpy(levels, 1.0), &[], Operator::Tufted).expect("a closed surface");
    bencher.bench_local(|| {
        Spectrum::smallest(&operator.stiffness, &operator.mass, k, &Options::default())
            .expect("a closed surface has a spectrum")
    });
}

/// Nearest rows among 2,500, for 2,500 rows of random numbers.
#[divan::bench(args = [20, 60, 100], sample_count = 20, sample_size = 1)]
fn nearest(bencher: Bencher<'_, '_>, dim: usize) {
    let mut rng = Pcg64::seed_from_u64(1);
    let mut rows = || -> Vec<f32> { (0..2_500 * dim).map(|_| rng.random()).collect() };
    let (queries, targets) = (rows(), rows());
    bencher
        .counter(ItemsCount::new(2_500_usize))
        .bench_local(|| nearest_rows(&queries, &targets, dim));
}

/// All 92 columns for the 2,500 faces of a proxy, kernels included.
#[divan::bench(sample_count = 20, sample_size = 1)]
fn describe_faces(bencher: Bencher<'_, '_>) {
    let proxy = proxy();
    bencher.bench_local(|| described(&proxy));
}

/// The over-segmentation of a proxy of 2,500 faces into 80 patches.
#[divan::bench(sample_count = 50, sample_size = 1)]
fn patches_of_proxy(bencher: Bencher<'_, '_>) {
    let proxy = proxy();
    let dual = DualGraph::new(&proxy.mesh, &proxy.bridges);
    let start = described(&proxy).farthest_start;
    bencher.bench_local(|| patches(&proxy.mesh, &dual, start, 80));
}

/// ZoomOut as published between 2,562 vertices each, from 20 to 100 eigenfunctions in steps of 10.
#[divan::bench(sample_count = 7, sample_size = 1)]
fn zoomout_on_all_vertices(bencher: Bencher<'_, '_>) {
    let (one, two) = (spectral(4, 1.0, 100), spectral(4, 1.2, 100));
    let mut start = vec![0.0; 20 * 20];
    start.iter_mut().step_by(21).for_each(|x| *x = 1.0);
    bencher.bench_local(|| zoomout(&one.basis(), &two.basis(), &start, 20, 10, 8));
}

/// A map between points without landmarks, and its mirrored alternative: 642 vertices each.
#[divan::bench(sample_count = 7, sample_size = 1)]
fn map_between_points(bencher: Bencher<'_, '_>) {
    let options = EstimateOptions::default();
    let (one, two) = (spectral(3, 1.0, 100), spectral(3, 1.2, 100));
    let (one, two) = (one.point_shape(&options), two.point_shape(&options));
    bencher.bench_local(|| point_maps(&one, &two, &[], &options));
}

/// The minimum cut of a square grid with random capacities.
#[divan::bench(args = [100, 300], sample_count = 20, sample_size = 1)]
fn minimum_cut(bencher: Bencher<'_, '_>, side: usize) {
    let mut rng = Pcg64::seed_from_u64(2);
    let mut network = Network::new(side * side);
    for node in 0..side * side {
        network.terminal(node, rng.random_range(0..100), rng.random_range(0..100));
        let right = (node % side + 1 < side).then_some(node + 1);
        let below = (node + side < side * side).then_some(node + side);
        for other in [right, below].into_iter().flatten() {
            network.edge(
                node,
                other,
                rng.random_range(0..60),
                rng.random_range(0..60),
            );
        }
    }
    bencher
        .with_inputs(|| network.clone())
        .bench_local_values(Network::sink_side);
}
