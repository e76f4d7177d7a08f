use super::*;

/// A normalisation that does not change its two descriptors.
fn normalisation() -> Normalisation {
    Normalisation {
        mean: vec![0.0; 2],
        deviation: vec![1.0; 2],
        up_known: false,
    }
}

/// Builds a shape whose parts have one patch each, or a patch for each of the given means.
fn shape(parts: &[(f64, &[[f32; 2]])]) -> ShapeParts {
    let mut out = ShapeParts {
        part_of_face: Vec::new(),
        part_of_patch: Vec::new(),
        patch_area: Vec::new(),
        patch_means: Vec::new(),
    };
    for (part, (area, places)) in parts.iter().enumerate() {
        for place in *places {
            out.part_of_face.push(part as u32);
            out.part_of_patch.push(part as u32);
            out.patch_area.push(area / places.len() as f64);
            out.patch_means.extend(place);
        }
    }
    out
}

/// Statistics of discovered labels around these means, with equal areas and little scatter.
fn discovered(places: &[[f32; 2]]) -> Statistics {
    let offsets = [[0.2, 0.0], [-0.2, 0.0], [0.0, 0.2], [0.0, -0.2]];
    let data: Vec<f32> = places
        .iter()
        .flat_map(|p| offsets.iter().flat_map(move |o| [p[0] + o[0], p[1] + o[1]]))
        .collect();
    let n = places.len() * offsets.len();
    let area = vec![1.0 / n as f64; n];
    let label = |f: usize| Some((f / offsets.len()) as u32);
    Statistics::of_shape(&Features { data, dim: 2 }, &area, label, places.len())
}

const LEG: [f32; 2] = [-1.0, 0.0];
const SEAT: [f32; 2] = [1.0, 0.0];
const ARM: [f32; 2] = [0.0, 1.5];

/// Three chairs with legs and a seat; the last also has an arm.
fn chairs() -> Vec<ShapeParts> {
    let legs: [[f32; 2]; 3] = [[-1.0, 0.0], [-1.05, 0.02], [-0.95, -0.02]];
    legs.iter()
        .enumerate()
        .map(|(i, leg)| {
            let seat = [SEAT[0] + 0.02 * i as f32, SEAT[1]];
            match i {
                2 => shape(&[(0.5, &[*leg]), (0.4, &[seat]), (0.1, &[ARM])]),
                _ => shape(&[(0.6, &[*leg]), (0.4, &[seat])]),
            }
        })
        .collect()
}

/// Returns the next question after these answers, each with shape, part and class.
fn question_after(
    shapes: &[ShapeParts],
    answers: &[(usize, u32, usize)],
    passed: &[(usize, u32)],
    k: usize,
) -> Option<Question> {
    let found = discovered(&[LEG, SEAT, ARM]);
    let normalisation = normalisation();
    let mut labelled: Vec<Vec<f64>> = shapes.iter().map(|s| vec![0.0; s.n_parts() * k]).collect();
    let mut open: Vec<Vec<bool>> = shapes.iter().map(|s| vec![true; s.n_parts()]).collect();
    for &(shape, part, class) in answers {
        let of_patch = shapes[shape].part_of_patch.iter();
        let of_part = of_patch
            .zip(&shapes[shape].patch_area)
            .filter(|p| *p.0 == part);
        labelled[shape][part as usize * k + class] = of_part.map(|p| p.1).sum();
        open[shape][part as usize] = false;
    }
    for &(shape, part) in passed {
        open[shape][part as usize] = false;
    }
    let all: Vec<CandidateShape<'_>> = shapes
        .iter()
        .zip(&labelled)
        .zip(&open)
        .map(|((parts, labelled), open)| CandidateShape {
            parts,
            labelled,
            open,
        })
        .collect();
    let known = Background {
        normalisation: &normalisation,
        discovered: &found,
        k,
    };
    next_question(&all, &known)
}

#[test]
fn the_first_question_is_of_the_kind_with_most_area() {
    let question = question_after(&chairs(), &[], &[], 0).unwrap();
    assert_eq!(question.part, 0, "{question:?}");
    assert!(
        (question.doubt - 1.0).abs() < 1e-9,
        "nobody has named a label"
    );
    // Of three discovered labels, all without a name, the first is that of legs.
    assert_eq!(question.likeliest[0].0, 0);
    assert!(question.likeliest[0].1 > 0.9, "{question:?}");
}

#[test]
fn an_answer_decides_parts_like_it_and_the_next_question_is_of_another_kind() {
    let chairs = chairs();
    let first = question_after(&chairs, &[], &[], 0).unwrap();
    let answers = [(first.shape, first.part, 0)];
    let second = question_after(&chairs, &answers, &[], 1).unwrap();
    assert_eq!(second.part, 1, "{second:?}");
    assert!(second.gain < first.gain);
    let answers = [answers[0], (second.shape, second.part, 1)];
    let third = question_after(&chairs, &answers, &[], 2).unwrap();
    assert_eq!((third.shape, third.part), (2, 2), "{third:?}");
    // Nobody has named the third discovered label, which is that of the arm: class 2 + 2.
    assert_eq!(third.likeliest[0].0, 4, "{third:?}");
    // With its name, the legs that are left are certain.
    let answers = [answers[0], answers[1], (2, 2, 2)];
    let fourth = question_after(&chairs, &answers, &[], 3).unwrap();
    assert!(fourth.doubt < 0.5, "{fourth:?}");
    let expected = usize::from(fourth.part == 1);
    assert_eq!(fourth.likeliest[0].0, expected, "{fourth:?}");
    assert_eq!(fourth.likeliest.len(), N_OFFERED);
}

#[test]
fn a_part_that_seems_to_be_of_two_kinds_is_not_asked_about_first() {
    let mixed = |area| shape(&[(area, &[LEG, SEAT]), (1.0 - area, &[LEG])]);
    let question = question_after(&[mixed(0.52), mixed(0.52)], &[], &[], 0).unwrap();
    assert_eq!(question.part, 1, "{question:?}");
}

#[test]
fn parts_that_are_closed_are_never_asked_about() {
    let chairs = chairs();
    let mut passed = Vec::new();
    while let Some(question) = question_after(&chairs, &[], &passed, 0) {
        assert!(!passed.contains(&(question.shape, question.part)));
        passed.push((question.shape, question.part));
    }
    assert_eq!(passed.len(), 7, "each part once");
    assert_eq!(question_after(&[], &[], &[], 0), None);
}

#[test]
fn the_same_shapes_ask_the_same_question() {
    let answers = [(0, 0, 0), (1, 1, 1)];
    let one = question_after(&chairs(), &answers, &[], 2);
    assert_eq!(one, question_after(&chairs(), &answers, &[], 2));
}

#[test]
fn parts_of_a_shape_depend_on_it_alone_and_cover_it() {
    use crate::mesh::Format;
    use crate::pipeline::{Params, describe};
    let mesh = crate::mesh::icosphere(3);
    let mut text = format!("OFF\n{} {} 0\n", mesh.vertices.len(), mesh.faces.len());
    for v in &mesh.vertices {
        // A dumbbell: thin in the middle.
        let waist = 0.3 + v[2] * v[2];
        text += &format!("{} {} {}\n", v[0] * waist, v[1] * waist, 3.0 * v[2]);
    }
    for f in &mesh.faces {
        text += &format!("3 {} {} {}\n", f[0], f[1], f[2]);
    }
    let description = describe(text.as_bytes(), Format::Off, &Params::default(), &|_| true);
    let description = description.unwrap();
    let parts = ShapeParts::new(&description.view(), None);
    assert_eq!(parts.n_parts(), N_PARTS);
    assert_eq!(parts.part_of_face.len(), description.faces.len());
    let area: f64 = parts.patch_area.iter().sum();
    assert!((area - 1.0).abs() < 1e-6, "{area}");
    assert_eq!(parts, ShapeParts::new(&description.view(), None));
}
