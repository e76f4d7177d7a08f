//! Generates candelabra: a base, a stem with knobs, and one to seven candles, of which all but the
//! middle one are on arms.

use crate::synth::dice::Dice;
use crate::synth::field::{Limb, Scene};
use crate::synth::vector::{Frame, Vec3, add, along, bezier, scale, turn};

pub(in crate::synth) const LABELS: &[&str] = &["base", "stem", "arm", "candle"];
const BASE: u32 = 0;
const STEM: u32 = 1;
const ARM: u32 = 2;
const CANDLE: u32 = 3;

const UP: Vec3 = [0.0, 1.0, 0.0];

pub(in crate::synth) fn scene(dice: &mut Dice) -> Scene {
    let mut scene = Scene::default();
    let n_candles = 1 + dice.pick(7);
    // An odd number has one on the stem; the others are on arms.
    let n_arms = n_candles - n_candles % 2;
    let high = dice.between(0.45, 0.75);
    let rod = dice.between(0.036, 0.046);
    base(&mut scene, dice, rod);

    let limb = scene.limb(0.04, 0.025);
    limb.cone(STEM, [0.0, 0.06, 0.0], [0.0, high, 0.0], 1.15 * rod, rod);
    for _ in 0..dice.pick(3) {
        let at = Frame::at([0.0, high * dice.between(0.3, 0.7), 0.0]);
        let wide = rod * dice.between(1.5, 2.0);
        limb.ellipsoid(STEM, at, [wide, dice.between(0.04, 0.07), wide]);
    }

    let cup = dice.between(0.065, 0.08);
    let wax = dice.between(0.034, 0.044);
    let long = dice.between(0.14, 0.3);
    let ring = dice.chance(0.5);
    let reach = dice.between(0.3, 0.4);
    let inner = dice.between(0.2, 0.26);
    let spacing = dice.between(0.17, 0.21);
    let step = dice.between(0.0, 0.06);
    let droop = dice.between(0.1, 0.28);
    let rise = dice.between(-0.04, 0.12);
    let turned = dice.between(0.0, 360.0);
    for i in 0..n_arms {
        // Arms form a ring around the stem, or lie in one plane, pair by pair, with lower outer
        // pairs.
        let (angle, far, root, level) = if ring {
            let far = reach * if n_arms > 4 { 1.1 } else { 1.0 };
            (
                turned + 360.0 * i as f64 / n_arms as f64,
                far,
                high,
                high + rise,
            )
        } else {
            let pair = (i / 2) as f64;
            let far = inner + spacing * pair;
            (
                180.0 * (i % 2) as f64,
                far,
                high - 0.11 * pair,
                high + rise - step * pair,
            )
        };
        let out = turn([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], angle);
        let start = [0.0, root - 0.08, 0.0];
        let end = along([0.0, level, 0.0], out, far);
        let points = bezier(
            [
                start,
                along(add(start, [0.0, -droop, 0.0]), out, 0.55 * far),
                along(add(end, [0.0, -droop - 0.08, 0.0]), out, 0.05),
                end,
            ],
            10,
        );
        let limb = scene.limb(0.025, 0.0);
        limb.tube(ARM, &points, 0.036, 0.03);
        candle(scene.limb(0.015, 0.01), end, cup, wax, long);
    }
    if n_candles % 2 == 1 {
        candle(
            scene.limb(0.015, 0.01),
            [0.0, high + 0.02, 0.0],
            cup,
            wax,
            long,
        );
    } else {
        let finial = Frame::at([0.0, high + 0.02, 0.0]);
        scene
            .limb(0.02, 0.0)
            .ellipsoid(STEM, finial, [0.05, 0.07, 0.05]);
    }
    scene
}

fn base(scene: &mut Scene, dice: &mut Dice, rod: f64) {
    let wide = dice.between(0.19, 0.27);
    let limb = scene.limb(0.0, 0.05);
    match dice.pick(3) {
        0 => {
            limb.disc(BASE, Frame::at([0.0, 0.0, 0.0]), wide, 0.04, 0.03);
            limb.ellipsoid(
                BASE,
                Frame::at([0.0, 0.03, 0.0]),
                [0.6 * wide, 0.08, 0.6 * wide],
            );
        }
        1 => {
            let square = [0.85 * wide, 0.04, 0.85 * wide];
            limb.block(BASE, Frame::at([0.0, 0.0, 0.0]), square, 0.03);
            limb.block(BASE, Frame::at([0.0, 0.06, 0.0]), scale(square, 0.6), 0.02);
        }
        _ => {
            // Three feet.
            let hub = [0.0, 0.1, 0.0];
            limb.cone(BASE, hub, along(hub, UP, 0.03), 1.9 * rod, 1.6 * rod);
            for i in 0..3 {
                let out = turn(
                    [1.0, 0.0, 0.0],
                    [0.0, 0.0, 1.0],
                    30.0 + 120.0 * f64::from(i),
                );
                let end = along([0.0, 0.0, 0.0], out, wide);
                let points = bezier(
                    [
                        hub,
                        along(add(hub, [0.0, 0.08, 0.0]), out, 0.5 * wide),
                        along(end, UP, 0.06),
                        end,
                    ],
                    6,
                );
                limb.tube(BASE, &points, 0.05, 0.042);
            }
        }
    }
}

/// Adds a drip pan with a candle.
fn candle(limb: &mut Limb, at: Vec3, cup: f64, wax: f64, long: f64) {
    limb.disc(CANDLE, Frame::at(at), cup, 0.03, 0.025);
    let middle = Frame::at(along(at, UP, long / 2.0));
    limb.disc(CANDLE, middle, wax, long / 2.0, 0.02);
}
