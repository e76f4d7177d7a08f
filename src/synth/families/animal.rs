//! Generates four-legged animals, standing or walking, with the common features of a dog, a cow, a
//! giraffe and a pig.

use crate::synth::dice::Dice;
use crate::synth::field::Scene;
use crate::synth::vector::{Frame, Vec3, add, along, cross, scale, turn, unit};

pub(in crate::synth) const LABELS: &[&str] = &["body", "head", "neck", "leg", "tail", "ear"];
const BODY: u32 = 0;
const HEAD: u32 = 1;
const NECK: u32 = 2;
const LEG: u32 = 3;
const TAIL: u32 = 4;
const EAR: u32 = 5;

const UP: Vec3 = [0.0, 1.0, 0.0];
const FRONT: Vec3 = [0.0, 0.0, 1.0];

pub(in crate::synth) fn scene(dice: &mut Dice) -> Scene {
    let mut scene = Scene::default();
    let length = dice.between(0.65, 1.05);
    let leg = dice.between(0.38, 0.8);
    let chest = dice.between(0.16, 0.24);
    let hips = chest * dice.between(0.75, 1.0);
    let slope = dice.between(-0.05, 0.12);
    let rear = [0.0, leg, -length / 2.0];
    let front = [0.0, leg + slope, length / 2.0];
    let belly = along(scale(add(rear, front), 0.5), UP, -dice.between(0.0, 0.05));
    let waist = (chest + hips) / 2.0 * dice.between(0.85, 1.1);
    scene
        .limb(0.0, 0.12)
        .cone(BODY, rear, belly, hips, waist)
        .cone(BODY, belly, front, waist, chest);

    // Legs: the pairs stride in opposite directions.
    let thick = dice.between(0.8, 1.25);
    // Degrees; on a short body long legs must not stride into each other.
    let stride = dice.between(-1.0, 1.0) * (14.0 * length / leg).min(24.0);
    for (end, hip_radius, is_front) in [(rear, hips, false), (front, chest, true)] {
        for side in [-1.0, 1.0] {
            let swing = stride * side * if is_front { 1.0 } else { -1.0 } + dice.between(-6.0, 6.0);
            // Thighs must not meet under a narrow body.
            let offset = (0.62 * hip_radius).max(0.02 + thigh(thick, is_front));
            let hip = [side * offset, end[1] - 0.15 * hip_radius, end[2]];
            let bend = dice.between(4.0, 28.0) * if is_front { 1.0 } else { -1.0 };
            legs(&mut scene, hip, leg, swing, bend, thick, is_front);
        }
    }

    // Neck and head.
    let reach = dice.between(0.22, 0.62);
    let pitch = dice.between(15.0, 75.0);
    let yaw = dice.between(-22.0, 22.0);
    let rise = turn(turn(FRONT, [1.0, 0.0, 0.0], yaw), UP, pitch);
    let nape = along(along(front, FRONT, 0.35 * chest), UP, 0.35 * chest);
    let top = along(nape, rise, reach);
    let skull = dice.between(0.1, 0.14);
    let neck = [
        skull * dice.between(0.72, 0.85),
        chest * dice.between(0.5, 0.66),
    ];
    scene
        .limb(0.07, 0.0)
        .cone(NECK, nape, top, neck[1], neck[0]);
    let gaze = turn(
        turn(FRONT, [1.0, 0.0, 0.0], 1.6 * yaw),
        UP,
        dice.between(-35.0, 8.0),
    );
    let muzzle = dice.between(0.12, 0.26);
    let centre = along(top, gaze, 0.35 * skull);
    let nose = along(centre, gaze, muzzle);
    let frame = Frame::facing(centre, gaze, UP);
    let crown = frame.axes[2];
    let snout = skull * dice.between(0.5, 0.72);
    scene
        .limb(0.03, 0.05)
        .ellipsoid(HEAD, frame, [skull, 1.15 * skull, 1.05 * skull])
        .cone(
            HEAD,
            along(centre, crown, -0.15 * skull),
            along(nose, crown, -0.3 * skull),
            0.8 * skull,
            snout,
        );

    // Ears: from small and round to long, upright or hanging.
    let ear = dice.between(0.08, 0.19);
    let lean = dice.between(12.0, 85.0);
    for side in [-1.0, 1.0] {
        let out = scale(frame.axes[0], side);
        let base = along(along(centre, crown, 0.66 * skull), out, 0.6 * skull);
        let base = along(base, gaze, -0.35 * skull);
        let direction = turn(crown, out, lean);
        let flat = Frame::facing(
            along(base, direction, 0.8 * ear),
            direction,
            cross(direction, gaze),
        );
        // The third axis of the frame is across the ear, the first its thickness.
        scene
            .limb(0.02, 0.0)
            .ellipsoid(EAR, flat, [0.038, ear, dice.between(0.055, 0.08)]);
    }

    // Tail: up, down or trailing.
    let n = 7;
    let long = dice.between(0.28, 0.75);
    let (mut angle, curl) = (dice.between(-65.0, 50.0), dice.between(-12.0, 14.0));
    let sway = dice.between(-8.0, 8.0);
    let mut at = along(along(rear, FRONT, -0.75 * hips), UP, 0.45 * hips);
    let mut points = vec![at];
    for i in 0..n {
        let back = turn([0.0, 0.0, -1.0], [1.0, 0.0, 0.0], sway * f64::from(i));
        // A tail as long as the legs must not reach the ground or the thighs.
        angle = (angle + curl).clamp(-68.0, 120.0);
        at = along(at, turn(back, UP, angle), long / f64::from(n));
        points.push(at);
    }
    let root = dice.between(0.042, 0.06);
    scene
        .limb(0.05, 0.01)
        .tube(TAIL, &points, root, dice.between(0.03, 0.045));
    scene
}

/// Radius of a leg at the body.
fn thigh(thick: f64, is_front: bool) -> f64 {
    if is_front { 0.085 * thick } else { 0.1 * thick }
}

/// Adds one leg; a straight one reaches down to y = 0.
fn legs(scene: &mut Scene, hip: Vec3, leg: f64, swing: f64, bend: f64, thick: f64, is_front: bool) {
    let down = [0.0, -1.0, 0.0];
    // The joint bends forward on hind legs (a knee) and backward on front legs (an elbow).
    let upper = turn(down, FRONT, swing - bend * 0.5);
    let lower = turn(down, FRONT, swing + bend * 0.5);
    let long = hip[1];
    let knee = along(hip, upper, 0.5 * long);
    let ankle = along(knee, lower, 0.42 * long);
    let toe = along(
        along(ankle, down, 0.03),
        unit([0.0, -0.1, 1.0]),
        0.07 + 0.02 * leg,
    );
    scene
        .limb(0.05, 0.03)
        .cone(LEG, hip, knee, thigh(thick, is_front), 0.055 * thick)
        .cone(LEG, knee, ankle, 0.055 * thick, 0.044 * thick)
        .cone(LEG, ankle, toe, 0.046 * thick, 0.04 * thick);
}
