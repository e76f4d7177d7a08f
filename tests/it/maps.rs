//! Compares maps between points with pyFM (pyfmaps 1.3.1) on its own pair of meshes, and tests them
//! through the library.

mod kept;
mod npz;

use crate::pipeline::{COLLECTION, SMALL, library, stream};
use coseg::fmap::convert::functional;
use coseg::fmap::operators::{crossing, multiplication};
use coseg::fmap::solve::{Energy, resolvent_mask};
use coseg::fmap::{Basis, Side, zoomout};
use coseg::library::{LibraryError, PointRequest, PolygonValues, Up};
use coseg::mesh::{self, Format, TriMesh};
use coseg::operators::{Operator, laplacian};
use coseg::spectrum::{Options, Spectrum};
use coseg::synth::{Family, family};
use nalgebra::{DMatrix, DVector};
use std::path::{Path, PathBuf};

/// The folder of pyFM's pair and reference arrays: beside the benchmark meshes.
fn peers() -> Option<PathBuf> {
    let data = std::env::var_os("COSEG_TEST_DATA").map(PathBuf::from)?;
    let peers = data.join("../peers");
    peers.join("ref/cat_lion.npz").exists().then_some(peers)
}

struct Meshed {
    values: Vec<f64>,
    vectors: Vec<f32>,
    mass: Vec<f32>,
}

impl Meshed {
    fn new(path: &Path, k: usize) -> Self {
        let parsed = mesh::parse(&std::fs::read(path).unwrap(), Format::Off).unwrap();
        let mut whole = TriMesh {
            vertices: parsed.vertices,
            faces: parsed.triangles,
        };
        let area: f64 = mesh::FaceGeometry::new(&whole).areas.iter().sum();
        for v in &mut whole.vertices {
            *v = v.map(|x| x / area.sqrt());
        }
        let l = laplacian(&whole, &[], Operator::Cotan).unwrap();
        let s = Spectrum::smallest(&l.stiffness, &l.mass, k, &Options::default()).unwrap();
        Self {
            values: s.eigenvalues,
            vectors: s
                .eigenvectors
                .transpose()
                .iter()
                .map(|x| *x as f32)
                .collect(),
            mass: l.mass.iter().map(|m| *m as f32).collect(),
        }
    }

    /// The results of pyFM.
    fn of_pyfm(path: &Path) -> Self {
        let single = |name: &str| -> Vec<f32> {
            let array = npz::read(path, name);
            array.values.iter().map(|x| *x as f32).collect()
        };
        Self {
            values: npz::read(path, "evals").values,
            vectors: single("evecs"),
            mass: single("mass_diag"),
        }
    }

    fn basis(&self) -> Basis<'_> {
        Basis {
            eigenvalues: &self.values,
            eigenvectors: &self.vectors,
            n_eigenvectors: self.values.len(),
            mass: &self.mass,
        }
    }
}

/// Number of vertices, of 5,000, that may differ: pyFM searches in double precision, and near ties
/// may go either way.
const MAX_OTHER: usize = 50;

#[test]
fn zoomout_from_the_same_map_is_that_of_pyfm() {
    let Some(peers) = peers() else {
        println!("skipped: COSEG_TEST_DATA/../peers/ref/cat_lion.npz is not there");
        return;
    };
    let reference = peers.join("ref/cat_lion.npz");
    let array = |name: &str| npz::read(&reference, name);
    let truth: Vec<u32> = array("gt_p2p21").values.iter().map(|x| *x as u32).collect();
    // Signs of eigenvectors are arbitrary, so entries agree in magnitude.
    let cat = Meshed::new(&peers.join("meshes/cat-00.off"), 20);
    let lion = Meshed::new(&peers.join("meshes/lion-00.off"), 20);
    let c = functional(&cat.basis(), &lion.basis(), &truth, 20, 20);
    let theirs = array("D_C0");
    assert_eq!(theirs.shape, [20, 20]);
    for (x, y) in c.iter().zip(&theirs.values) {
        assert!((f64::from(x.abs()) - y.abs()).abs() < 1e-3, "{x} {y}");
    }
    let Some(full) = std::env::var_os("COSEG_TEST_PEERS").map(PathBuf::from) else {
        println!("skipped: COSEG_TEST_PEERS does not name the folder of pyFM's bases");
        return;
    };
    let cat = Meshed::of_pyfm(&full.join("cat-00_spectrum.npz"));
    let lion = Meshed::of_pyfm(&full.join("lion-00_spectrum.npz"));
    let c: Vec<f32> = theirs.values.iter().map(|x| *x as f32).collect();
    let (large, p2p_21) = zoomout(&cat.basis(), &lion.basis(), &c, 20, 5, 36);
    assert_eq!(large.len(), 200 * 200);
    let theirs = array("D_zo_p2p21").values;
    let other = p2p_21
        .iter()
        .zip(&theirs)
        .filter(|(x, y)| f64::from(**x) != **y);
    let other = other.count();
    println!(
        "{other} of {} vertices go elsewhere than with pyFM",
        theirs.len()
    );
    assert!(other <= MAX_OTHER, "{other} of {} vertices", theirs.len());
}

/// pyFM's normalisation of the four terms (`canonical_taus`), so that the energies are equal.
struct Weights {
    probes: f64,
    mask: f64,
    multiplied: f64,
    crossed: f64,
}

fn p_effective(f: &DMatrix<f64>) -> f64 {
    let inner = f.rows(1, f.nrows() - 1);
    let gram = inner.transpose() * inner;
    gram.trace().powi(2) / gram.norm_squared()
}

/// On its basis and descriptors and by its energy, no map of pyFM is better than ours. Needs the
/// arrays of a full run of its script: COSEG_TEST_PEERS names their folder.
#[test]
fn no_map_of_pyfm_has_less_energy() {
    let (Some(peers), Some(full)) = (
        peers(),
        std::env::var_os("COSEG_TEST_PEERS").map(PathBuf::from),
    ) else {
        println!(
            "skipped: COSEG_TEST_DATA and COSEG_TEST_PEERS do not name pyFM's meshes and arrays"
        );
        return;
    };
    let k = 30;
    let side = |mesh: &str, descriptors: &str| {
        let path = full.join(format!("{mesh}_spectrum.npz"));
        let vectors = npz::read(&path, "evecs");
        let n = vectors.shape[0];
        let vectors = DMatrix::from_row_slice(n, vectors.shape[1], &vectors.values);
        let x = npz::read(&full.join("cat_lion_maps.npz"), descriptors);
        let x = DMatrix::from_row_slice(n, x.shape[1], &x.values);
        let off = std::fs::read(peers.join(format!("meshes/{mesh}.off"))).unwrap();
        (
            vectors.columns(0, k).into_owned(),
            npz::read(&path, "mass_diag").values,
            npz::read(&path, "evals").values[..k].to_vec(),
            x,
            mesh::parse(&off, Format::Off).unwrap().triangles,
        )
    };
    let (phi1, mass1, values1, x1, faces1) = side("cat-00", "A_descr1");
    let (phi2, mass2, values2, x2, faces2) = side("lion-00", "A_descr2");
    let project = |phi: &DMatrix<f64>, mass: &[f64], x: &DMatrix<f64>| {
        phi.transpose() * DMatrix::from_fn(x.nrows(), x.ncols(), |i, j| mass[i] * x[(i, j)])
    };
    let (f, g) = (project(&phi1, &mass1, &x1), project(&phi2, &mass2, &x2));
    let column = |x: &DMatrix<f64>, j: usize| x.column(j).iter().copied().collect::<Vec<f64>>();
    let n = x1.ncols();
    let multiplied: Vec<_> = (0..n)
        .map(|j| {
            (
                multiplication(&phi1, &mass1, &column(&x1, j)),
                multiplication(&phi2, &mass2, &column(&x2, j)),
            )
        })
        .collect();
    let crossed: Vec<_> = (0..n)
        .map(|j| {
            (
                crossing(&faces1, &phi1, &column(&x1, j)),
                crossing(&faces2, &phi2, &column(&x2, j)),
            )
        })
        .collect();
    let mask = resolvent_mask(&values1, &values2, 0.5);
    let p = 0.5 * (p_effective(&f) + p_effective(&g));
    let size = k as f64;
    let spread = |pairs: &[(DMatrix<f64>, DMatrix<f64>)], skew: bool| {
        let of = |(x, y): &(DMatrix<f64>, DMatrix<f64>)| {
            let cross = if skew {
                0.0
            } else {
                2.0 * x.trace() * y.trace()
            };
            size * (x.norm_squared() + y.norm_squared()) - cross
        };
        pairs.iter().map(of).sum::<f64>() / size / p
    };
    let tau = Weights {
        probes: f.rows(1, k - 1).norm_squared() / p,
        mask: mask.sum() / size,
        multiplied: spread(&multiplied, false),
        crossed: spread(&crossed, true),
    };
    for (name, w) in [
        ("A_fit_readme_C", [1.0, 0.1, 1.0, 1.0]),
        ("A_fit_noorient_C", [1.0, 0.1, 1.0, 0.0]),
        ("A_fit_default_C", [0.1, 1e-3, 1.0, 0.0]),
    ] {
        let total: f64 = w.iter().sum();
        let weighted = |pairs: &[(DMatrix<f64>, DMatrix<f64>)], weight: f64| {
            let kept = pairs.iter().filter(|_| weight > 0.0);
            kept.map(|(x, y)| (x.clone(), y.clone(), weight))
                .collect::<Vec<_>>()
        };
        let mut operators = weighted(&multiplied, w[2] / total / tau.multiplied);
        operators.extend(weighted(&crossed, w[3] / total / tau.crossed));
        let energy = Energy {
            probes_1: f.clone(),
            probes_2: g.clone(),
            probe_weight: w[0] / total / tau.probes,
            mask: mask.clone(),
            mask_weight: w[1] / total / tau.mask,
            operators,
        };
        let theirs = npz::read(&full.join("cat_lion_maps.npz"), name);
        let theirs = DMatrix::from_row_slice(k, k, &theirs.values);
        let first: DVector<f64> = theirs.column(0).into_owned();
        let ours = energy.minimiser(&first).unwrap();
        let (a, b) = (energy.value(&ours), energy.value(&theirs));
        println!("{name}: energy {a:.9} against {b:.9}");
        assert!(a <= b * (1.0 + 1e-6), "{name}: {a} against {b}");
        // The energy is the same: their map is a minimum of it too, up to the tolerance of their
        // search.
        assert!(b < a * 1.02 + 1e-9, "{name}: {a} against {b}");
    }
}

#[test]
fn the_library_maps_points_and_carries_values() {
    let shapes = family(Family::Animal, 5, 2, &SMALL);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let (a, b) = (shapes[0].name.as_str(), shapes[1].name.as_str());
    let request = PointRequest {
        alternative: true,
        ..PointRequest::default()
    };
    let maps = library.point_maps(COLLECTION, a, b, &request).unwrap();
    assert_eq!(
        maps,
        library.point_maps(COLLECTION, a, b, &request).unwrap()
    );
    let target = library.description(COLLECTION, b).unwrap();
    assert_eq!(maps[0].p2p_21.len(), target.view().vertices.len());
    assert_eq!(maps[0].c_12.len(), maps[0].k * maps[0].k);
    assert!(maps.len() == 2 && maps[0].orientation * maps[1].orientation < 0.0);
    assert!(maps[0].expected_error > 0.0 && maps[0].quality.coverage > 0.2);
    let keep = PointRequest {
        side: Side::Keep,
        k: 20,
        ..PointRequest::default()
    };
    let small = library.point_maps(COLLECTION, a, b, &keep).unwrap();
    assert!(small.len() == 1 && small[0].k == 20 && small[0].orientation > 0.0);

    let truth = |s: usize| {
        shapes[s]
            .labels
            .iter()
            .map(|l| *l as i32)
            .collect::<Vec<i32>>()
    };
    let labels = PolygonValues::Labels(truth(0));
    let (carried, _) = library
        .transfer(COLLECTION, a, b, &labels, &request)
        .unwrap();
    let PolygonValues::Labels(carried) = carried else {
        panic!("labels stay labels");
    };
    let hits = carried
        .iter()
        .zip(truth(1))
        .filter(|(x, y)| **x == *y)
        .count();
    assert!(
        hits as f64 > 0.6 * carried.len() as f64,
        "{hits} of {}",
        carried.len()
    );
    let ones = PolygonValues::Functions(vec![1.0; 2 * shapes[0].labels.len()], 2);
    let (carried, _) = library.transfer(COLLECTION, a, b, &ones, &request).unwrap();
    let PolygonValues::Functions(values, 2) = carried else {
        panic!("functions stay functions");
    };
    assert_eq!(values.len(), 2 * shapes[1].labels.len());
    assert!(values.iter().all(|x| x.is_nan() || (x - 1.0).abs() < 1e-4));
    let known = values.iter().filter(|x| !x.is_nan()).count();
    assert!(
        known as f64 > 0.7 * values.len() as f64,
        "{known} of {}",
        values.len()
    );

    let refused = |r: Result<(), LibraryError>| r.unwrap_err().to_string();
    let short = PolygonValues::Labels(vec![1, 2]);
    let e = refused(
        library
            .transfer(COLLECTION, a, b, &short, &request)
            .map(|_| ()),
    );
    assert!(e.contains("2 rows"), "{e}");
    let nowhere = PointRequest {
        landmarks: vec![[0, 9_999_999]],
        ..PointRequest::default()
    };
    let e = refused(library.point_maps(COLLECTION, a, b, &nowhere).map(|_| ()));
    assert!(e.contains("9999999"), "{e}");
}
