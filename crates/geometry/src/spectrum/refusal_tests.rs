use super::{Options, Progress, Spectrum, SpectrumError};
use crate::operators::test_meshes::{bumpy_torus, icosphere};
use crate::operators::{Operator, laplacian};
use std::cell::{Cell, RefCell};

#[test]
fn cancels_at_every_stage() {
    let operator = laplacian(&bumpy_torus(40, 30), &[], Operator::Tufted).unwrap();
    let run = |stop_after: usize| {
        let calls = Cell::new(0);
        let hook = |_: &Progress| {
            calls.set(calls.get() + 1);
            calls.get() <= stop_after
        };
        let options = Options {
            progress: Some(&hook),
            ..Options::default()
        };
        let result = Spectrum::smallest(&operator.stiffness, &operator.mass, 60, &options);
        (result, calls.get())
    };
    let (result, total) = run(usize::MAX);
    assert!(result.is_ok() && total > 20);
    for stop_after in 0..total {
        let (result, calls) = run(stop_after);
        assert!(matches!(result, Err(SpectrumError::Cancelled { .. })));
        assert_eq!(calls, stop_after + 1, "nothing is called after a cancel");
    }
}

#[test]
fn tells_how_far_it_is() {
    let operator = laplacian(&bumpy_torus(60, 40), &[], Operator::Tufted).unwrap();
    let seen = RefCell::new(Vec::new());
    let hook = |p: &Progress| {
        seen.borrow_mut().push(*p);
        true
    };
    let options = Options {
        progress: Some(&hook),
        ..Options::default()
    };
    let found = Spectrum::smallest(&operator.stiffness, &operator.mass, 50, &options).unwrap();
    let iterate: Vec<Progress> = seen
        .take()
        .into_iter()
        .filter(|p| p.stage == "iterate")
        .collect();
    // The hook is called once for each block, each time with more vectors; the last call ends the
    // space.
    assert!(iterate.windows(2).all(|w| w[0].done < w[1].done));
    assert!(iterate.iter().all(|p| p.done < p.expected));
    let n_krylov = found.certificate.n_krylov;
    assert_eq!(iterate.len(), n_krylov / crate::linalg::panel::WIDTH);
    assert_eq!(iterate[iterate.len() - 1].expected, n_krylov);
}

#[test]
fn refuses_what_has_no_spectrum() {
    let good = laplacian(&icosphere(1), &[], Operator::Cotan).unwrap();
    let n = good.mass.len();
    let options = Options::default();
    let of =
        |w: &sprs::CsMat<f64>, a: &[f64], k| Spectrum::smallest(w, a, k, &options).unwrap_err();
    let message = |e: SpectrumError| e.to_string();
    assert_eq!(
        message(of(&good.stiffness, &good.mass, 0)),
        "0 eigenpairs were requested, but the limits are 1 and 42"
    );
    assert!(matches!(
        of(&good.stiffness, &good.mass, n + 1),
        SpectrumError::Count { .. }
    ));
    assert!(matches!(
        of(&good.stiffness, &good.mass[1..], 3),
        SpectrumError::MassLength { .. }
    ));
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e-310] {
        let mut mass = good.mass.clone();
        mass[5] = bad;
        assert!(matches!(
            of(&good.stiffness, &mass, 3),
            SpectrumError::Mass { vertex: 5, .. }
        ));
    }
    let mut w = good.stiffness.clone();
    *w.get_mut(3, 3).unwrap() = f64::NAN;
    assert!(matches!(
        of(&w, &good.mass, 3),
        SpectrumError::Stiffness {
            row: 3,
            column: 3,
            ..
        }
    ));
    let mut w = good.stiffness.clone();
    let column = w.outer_view(7).unwrap().indices()[1];
    *w.get_mut(7, column).unwrap() += 0.1;
    assert!(matches!(
        of(&w, &good.mass, 3),
        SpectrumError::NotSymmetric { .. }
    ));
    let negative = good.stiffness.map(|x| -x);
    assert!(matches!(
        of(&negative, &good.mass, 3),
        SpectrumError::NotSemidefinite { .. }
    ));
    let large = laplacian(&icosphere(3), &[], Operator::Cotan).unwrap();
    let negative = large.stiffness.map(|x| -x);
    assert!(Spectrum::smallest(&negative, &large.mass, 30, &options).is_err());
    let wide = sprs::CsMat::<f64>::zero((3, 4));
    assert!(matches!(
        of(&wide, &[1.0; 3], 1),
        SpectrumError::NotSquare { .. }
    ));
    let loose = Options {
        tolerance: 0.5,
        ..options
    };
    assert!(matches!(
        Spectrum::smallest(&good.stiffness, &good.mass, 3, &loose),
        Err(SpectrumError::Tolerance { .. })
    ));
}
