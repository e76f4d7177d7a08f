//! Generates birds: standing with folded wings, or with wings spread; with short or long necks.

use crate::synth::dice::Dice;
use crate::synth::field::Scene;
use crate::synth::solid::Solid;
use crate::synth::vector::{Frame, Vec3, add, along, bezier, closed_curve, scale, turn};

pub(in crate::synth) const LABELS: &[&str] = &["body", "head", "neck", "wing", "tail", "leg"];
const BODY: u32 = 0;
const HEAD: u32 = 1;
const NECK: u32 = 2;
const WING: u32 = 3;
const TAIL: u32 = 4;
const LEG: u32 = 5;

const UP: Vec3 = [0.0, 1.0, 0.0];
const FRONT: Vec3 = [0.0, 0.0, 1.0];

pub(in crate::synth) fn scene(dice: &mut Dice) -> Scene {
    let mut scene = Scene::default();
    let spread = dice.chance(0.5);
    // In flight the legs may be tucked away.
    let with_legs = !spread || dice.chance(0.5);
    let with_neck = dice.chance(0.5);

    let radius = dice.between(0.15, 0.2);
    let length = radius * dice.between(1.7, 2.3);
    let tilt = if spread {
        dice.between(-5.0, 20.0)
    } else {
        dice.between(8.0, 45.0)
    };
    let ahead = turn(FRONT, UP, tilt);
    let frame = Frame::facing([0.0, 0.55, 0.0], ahead, UP);
    let back = frame.axes[2];
    scene
        .limb(0.0, 0.0)
        .ellipsoid(BODY, frame, [radius, length, 0.95 * radius]);

    // Head, on a neck or on the shoulders.
    let shoulder = along(
        along(frame.origin, ahead, 0.72 * length),
        back,
        0.3 * radius,
    );
    let skull = dice.between(0.095, 0.125);
    let gaze = turn(
        turn(FRONT, [1.0, 0.0, 0.0], dice.between(-40.0, 40.0)),
        UP,
        dice.between(-20.0, 8.0),
    );
    let head = if with_neck {
        let long = dice.between(0.3, 0.6);
        let rise = turn(FRONT, UP, dice.between(35.0, 80.0));
        let top = along(shoulder, rise, long);
        let bow = dice.between(0.0, 0.45) * long;
        let lower = along(along(shoulder, ahead, 0.5 * long), UP, -0.2 * bow);
        let upper = along(along(top, UP, -0.5 * long), FRONT, -bow);
        let points = bezier([shoulder, lower, upper, top], 8);
        scene.limb(0.08, 0.0).tube(NECK, &points, 0.085, 0.055);
        along(top, UP, 0.3 * skull)
    } else {
        along(
            shoulder,
            turn(ahead, back, 35.0),
            0.2 * length + dice.between(0.4, 0.75) * skull,
        )
    };
    let beak = dice.between(0.12, 0.3);
    let tip = along(
        along(head, gaze, skull + beak),
        UP,
        -dice.between(0.0, 0.06),
    );
    scene
        .limb(0.04, 0.03)
        .cone(
            HEAD,
            head,
            along(head, gaze, 0.25 * skull),
            skull,
            0.9 * skull,
        )
        .cone(HEAD, along(head, gaze, 0.7 * skull), tip, 0.055, 0.027);

    // Tail: a flat fan.
    let fan = dice.between(0.22, 0.5);
    let half_width = dice.between(0.05, 0.08);
    let flare = half_width * dice.between(1.0, 2.4);
    let trail = turn(scale(ahead, -1.0), back, dice.between(-12.0, 25.0));
    let root = along(frame.origin, ahead, -0.8 * length);
    let flat = Frame::facing(root, trail, back);
    let outline = [
        [-half_width, -0.04],
        [half_width, -0.04],
        [flare, fan],
        [0.0, 1.08 * fan],
        [-flare, fan],
    ];
    let outline = closed_curve(&outline, 5);
    let plate = Solid::Plate {
        frame: flat,
        outline,
        half: 0.004,
        round: 0.03,
    };
    scene.limb(0.05, 0.0).solid(TAIL, plate);

    if spread {
        spread_wings(&mut scene, dice, frame, radius, length);
    } else {
        folded_wings(&mut scene, dice, frame, radius, length);
    }
    if with_legs {
        legs(&mut scene, dice, frame, radius, length);
    }
    scene
}

fn folded_wings(scene: &mut Scene, dice: &mut Dice, body: Frame, radius: f64, length: f64) {
    let long = length * dice.between(0.8, 1.0);
    let deep = radius * dice.between(0.55, 0.7);
    let away = dice.between(2.0, 14.0);
    for side in [-1.0, 1.0] {
        let out = scale(body.axes[0], side);
        // Wings hang from the shoulders, so they stand off more towards the tail.
        let aft = turn(scale(body.axes[1], -1.0), out, away);
        let start = along(
            along(body.origin, out, 1.02 * radius),
            body.axes[1],
            0.45 * length,
        );
        let centre = along(along(start, aft, 0.9 * long), body.axes[2], 0.15 * radius);
        let frame = Frame::facing(centre, aft, body.axes[2]);
        scene
            .limb(0.025, 0.0)
            .ellipsoid(WING, frame, [0.05, long, deep]);
    }
}

fn spread_wings(scene: &mut Scene, dice: &mut Dice, body: Frame, radius: f64, length: f64) {
    let span = dice.between(0.6, 1.05);
    let chord = length * dice.between(0.55, 0.8);
    let sweep = dice.between(-0.05, 0.4) * span;
    let point = dice.between(0.25, 0.75);
    let (dihedral, fold) = (dice.between(-22.0, 45.0), dice.between(-30.0, 15.0));
    for side in [-1.0, 1.0] {
        let out = scale(body.axes[0], side);
        let arm = turn(out, body.axes[2], dihedral);
        let hand = turn(out, body.axes[2], dihedral + fold);
        let root = add(body.origin, scale(body.axes[1], 0.25 * length));
        let root = along(along(root, out, 0.45 * radius), body.axes[2], 0.35 * radius);
        // Inner wing along the arm, outer wing along the hand; x of the outline runs aft.
        let wrist = along(root, arm, 0.5 * span);
        let mean = 0.5 * chord;
        let inner = [
            [-mean, -0.02],
            [mean, -0.02],
            [0.95 * mean, 0.5 * span],
            [-1.05 * mean, 0.5 * span],
        ];
        let tip = point * 0.5 * mean;
        let outer = [
            [-1.05 * mean, -0.01],
            [0.95 * mean, -0.01],
            [sweep + tip, 0.42 * span],
            [sweep, 0.52 * span],
            [sweep - tip, 0.42 * span],
        ];
        let aft = scale(body.axes[1], -1.0);
        let plane = |origin, y: Vec3| {
            let normal = crate::synth::vector::cross(aft, y);
            Frame {
                origin,
                axes: [aft, y, normal],
            }
        };
        let outer = closed_curve(&outer, 4);
        scene
            .limb(0.05, 0.02)
            .solid(
                WING,
                Solid::Plate {
                    frame: plane(root, arm),
                    outline: inner.to_vec(),
                    half: 0.003,
                    round: 0.032,
                },
            )
            .solid(
                WING,
                Solid::Plate {
                    frame: plane(wrist, hand),
                    outline: outer,
                    half: 0.001,
                    round: 0.03,
                },
            );
    }
}

fn legs(scene: &mut Scene, dice: &mut Dice, body: Frame, radius: f64, length: f64) {
    let long = dice.between(0.22, 0.5);
    let stride = dice.between(-18.0, 18.0);
    let thigh = dice.between(0.05, 0.065);
    for side in [-1.0, 1.0] {
        let hip = along(body.origin, body.axes[1], -0.12 * length);
        let hip = add(hip, [side * 0.5 * radius, -0.55 * radius, 0.0]);
        let down = turn([0.0, -1.0, 0.0], FRONT, stride * side);
        let knee = along(along(hip, down, 0.5 * long + 0.05), FRONT, -0.02);
        let foot = along(
            knee,
            turn([0.0, -1.0, 0.0], FRONT, stride * side - 6.0),
            0.5 * long,
        );
        let limb = scene.limb(0.03, 0.015);
        limb.cone(LEG, hip, knee, thigh, 0.036)
            .cone(LEG, knee, foot, 0.034, 0.03);
        for spread in [-38.0, 0.0, 38.0] {
            let toe = along(foot, turn(FRONT, [1.0, 0.0, 0.0], spread), 0.13);
            limb.cone(LEG, foot, along(toe, UP, -0.012), 0.032, 0.026);
        }
        limb.cone(LEG, foot, add(foot, [0.0, -0.01, -0.08]), 0.032, 0.026);
    }
}
