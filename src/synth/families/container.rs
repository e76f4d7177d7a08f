//! Generates containers: hollow cups, vases, jugs and goblets with up to two handles.

use crate::synth::dice::Dice;
use crate::synth::field::Scene;
use crate::synth::solid::Solid;
use crate::synth::vector::{Frame, Vec3, bezier, open_curve, turn};

pub(in crate::synth) const LABELS: &[&str] = &["body", "neck", "handle", "foot"];
const BODY: u32 = 0;
const NECK: u32 = 1;
const HANDLE: u32 = 2;
const FOOT: u32 = 3;

/// Half the thickness of the wall.
const WALL: f64 = 0.03;

pub(in crate::synth) fn scene(dice: &mut Dice) -> Scene {
    let mut scene = Scene::default();
    let with_neck = dice.chance(0.5);
    let with_foot = dice.chance(0.4);
    let n_handles = dice.pick(3);
    let ground = if with_foot {
        dice.between(0.12, 0.32)
    } else {
        0.0
    };
    let frame = Frame::at([0.0, ground, 0.0]);

    let tall = if with_neck {
        dice.between(0.42, 0.6)
    } else {
        dice.between(0.4, 0.75)
    };
    let bottom = dice.between(0.13, 0.2);
    let belly = dice.between(0.22, 0.33);
    let mut profile = vec![[0.0, 0.0], [0.6 * bottom, 0.0], [bottom, 0.015]];
    if with_neck {
        let at = dice.between(0.4, 0.6);
        let throat = dice.between(0.1, 0.14);
        profile.extend([
            [belly, at * tall],
            [0.8 * belly + 0.2 * throat, 0.82 * tall],
            [throat, tall],
        ]);
    } else {
        let mouth = dice.between(0.18, 0.32);
        let at = dice.between(0.35, 0.6);
        profile.extend([
            [0.5 * (belly + mouth).max(2.0 * bottom), at * tall],
            [mouth, tall],
        ]);
    }
    let profile = open_curve(&profile, 5);
    let wall = profile.clone();
    scene.limb(0.0, 0.0).solid(
        BODY,
        Solid::Shell {
            frame,
            profile,
            round: WALL,
        },
    );

    let mut top = tall;
    let mut neck_radius = 0.0;
    if with_neck {
        let throat = wall[wall.len() - 1][0];
        let high = dice.between(0.2, 0.4);
        let lip = throat * dice.between(1.0, 1.6);
        let points = [
            [throat, tall],
            [throat, tall + 0.6 * high],
            [lip, tall + high],
        ];
        let profile = open_curve(&points, 5);
        scene.limb(0.025, 0.0).solid(
            NECK,
            Solid::Shell {
                frame,
                profile,
                round: WALL,
            },
        );
        top = tall + high;
        neck_radius = throat;
    }
    if with_foot {
        let stem = dice.between(0.045, 0.07);
        let base = dice.between(0.15, 0.22);
        let limb = scene.limb(0.03, 0.05);
        limb.cone(
            FOOT,
            [0.0, ground - 0.01, 0.0],
            [0.0, 0.04, 0.0],
            stem,
            1.2 * stem,
        );
        limb.disc(FOOT, Frame::at([0.0, 0.0, 0.0]), base, 0.035, 0.03);
    }
    if n_handles > 0 {
        let thick = dice.between(0.036, 0.046);
        let away = dice.between(0.14, 0.26);
        // A handle on the body alone, or from the neck down to the shoulder.
        let from_neck = with_neck && dice.chance(0.6);
        let (low, high) = if from_neck {
            (
                tall * dice.between(0.5, 0.62),
                tall + (top - tall) * dice.between(0.45, 0.7),
            )
        } else {
            (
                tall * dice.between(0.2, 0.32),
                tall * dice.between(0.72, 0.84),
            )
        };
        let lift = dice.between(-0.04, 0.1);
        let turned = dice.between(0.0, 360.0);
        for i in 0..n_handles {
            let out = turn([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], turned + 180.0 * i as f64);
            let at = |r: f64, y: f64| -> Vec3 { [r * out[0], y + ground, r * out[2]] };
            // The ends stay within the wall, so that they do not show inside.
            let shift = thick - WALL;
            let start = if from_neck {
                neck_radius
            } else {
                radius_at(&wall, high)
            } + shift;
            let end = radius_at(&wall, low) + shift;
            let far = start.max(end) + away;
            let points = bezier(
                [
                    at(start, high),
                    at(far, high + lift),
                    at(far, low - 0.3 * lift),
                    at(end, low),
                ],
                12,
            );
            scene.limb(0.04, 0.0).tube(HANDLE, &points, thick, thick);
        }
    }
    scene
}

/// The largest radius of a profile at a height.
fn radius_at(profile: &[[f64; 2]], y: f64) -> f64 {
    let spans = profile
        .windows(2)
        .filter(|w| (w[0][1] <= y) != (w[1][1] <= y));
    let radii = spans.map(|w| {
        let t = (y - w[0][1]) / (w[1][1] - w[0][1]);
        w[0][0] + t * (w[1][0] - w[0][0])
    });
    radii.fold(0.0, f64::max)
}
