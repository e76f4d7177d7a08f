//! Generates pliers: two levers that cross at a joint, with pointed, flat or curved jaws and
//! straight or bowed handles.

use crate::synth::dice::Dice;
use crate::synth::field::Scene;
use crate::synth::solid::Solid;
use crate::synth::vector::{Frame, Vec3, bezier};

pub(in crate::synth) const LABELS: &[&str] = &["handle", "jaw", "joint"];
const HANDLE: u32 = 0;
const JAW: u32 = 1;
const JOINT: u32 = 2;

pub(in crate::synth) fn scene(dice: &mut Dice) -> Scene {
    let mut scene = Scene::default();
    let joint = dice.between(0.1, 0.14);
    let flat = dice.between(0.05, 0.065);
    // The second axis of a disc is its axis; pliers lie in the plane of x and y.
    let axle = Frame::at([0.0; 3]).turned(1, 2, 90.0);
    scene
        .limb(0.0, 0.0)
        .disc(JOINT, axle, joint, 1.25 * flat, 0.03);
    if dice.chance(0.6) {
        scene
            .limb(0.02, 0.0)
            .disc(JOINT, axle, 0.5 * joint, 1.25 * flat + 0.03, 0.02);
    }

    let open = dice.between(7.0, 24.0);
    let kind = dice.pick(3);
    let jaw = dice.between(0.26, 0.55);
    let handle = dice.between(0.6, 0.95);
    let bow = dice.between(0.06, 0.2);
    let flare = dice.between(-0.05, 0.09);
    let grip = dice.between(0.045, 0.068);
    for side in [-1.0, 1.0] {
        // Half of the opening for each lever; its jaw is on the other side of its handle.
        let lever = Frame::at([0.0; 3]).turned(0, 1, side * open);
        let at = |x: f64, y: f64| -> Vec3 { lever.world([-side * x, y, 0.0]) };
        let limb = scene.limb(0.03, 0.02);
        match kind {
            0 => {
                // Needle nose.
                limb.cone(JAW, at(0.085, 0.05), at(0.05, jaw), 1.1 * flat, 0.032);
            }
            1 => {
                // Flat, broad.
                let width = 0.9 * flat;
                let outline = vec![
                    [-side * 0.045, 0.0],
                    [-side * (0.05 + 1.4 * width), 0.0],
                    [-side * (0.05 + 1.0 * width), 0.8 * jaw],
                    [-side * 0.045, 0.8 * jaw],
                ];
                let solid = Solid::Plate {
                    frame: lever,
                    outline,
                    half: flat - 0.03,
                    round: 0.03,
                };
                limb.solid(JAW, solid);
            }
            _ => {
                // Curved, meeting at the tips.
                let out = dice.between(0.13, 0.17);
                let points = bezier(
                    [
                        at(0.04, 0.05),
                        at(out, 0.2 * jaw),
                        at(out, 0.75 * jaw),
                        at(0.05, 0.9 * jaw),
                    ],
                    8,
                );
                limb.tube(JAW, &points, flat, 0.036);
            }
        }
        let ends = [
            at(-0.04, -0.05),
            at(-0.02 - bow, -0.25 * handle),
            at(-0.06 - bow, -0.6 * handle),
            at(-0.07 - bow - flare, -handle),
        ];
        let points = bezier(ends, 10);
        scene
            .limb(0.03, 0.0)
            .tube(HANDLE, &points, 0.8 * grip, grip);
    }
    scene
}
