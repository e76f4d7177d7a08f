//! Generates guitars: body, neck and head, from the classical figure of eight to arrow-shaped
//! electric ones.

use crate::synth::dice::Dice;
use crate::synth::field::Scene;
use crate::synth::solid::Solid;
use crate::synth::vector::{Frame, closed_curve, turn};

pub(in crate::synth) const LABELS: &[&str] = &["body", "neck", "head"];
const BODY: u32 = 0;
const NECK: u32 = 1;
const HEAD: u32 = 2;

pub(in crate::synth) fn scene(dice: &mut Dice) -> Scene {
    let mut scene = Scene::default();
    let frame = Frame::at([0.0; 3]);
    let length = dice.between(0.42, 0.56);
    let kind = dice.pick(4);
    let (points, thick, blend, acoustic) = match kind {
        0 => (
            classical(dice, length),
            dice.between(0.06, 0.085),
            0.01,
            true,
        ),
        1 => (
            horned(dice, length),
            dice.between(0.042, 0.055),
            0.01,
            false,
        ),
        2 => (arrow(dice, length), dice.between(0.042, 0.05), 0.01, false),
        _ => (pear(dice, length), dice.between(0.06, 0.09), 0.02, true),
    };
    let outline = closed_curve(&points, 5);
    let body = Solid::Plate {
        frame,
        outline,
        half: thick - 0.03,
        round: 0.03,
    };
    scene.limb(0.0, 0.0).solid(BODY, body);

    // The neck runs up from the body, raised to the level of its top.
    let neck = dice.between(0.42, 0.72);
    let half_width = dice.between(0.034, 0.044);
    let level = thick - 0.012;
    let (low, high) = (0.32 * length, 0.5 * length + neck);
    let middle = Frame::at([0.0, (low + high) / 2.0, level]);
    let half = [half_width, (high - low) / 2.0, 0.036];
    scene.limb(blend, 0.0).block(NECK, middle, half, 0.026);

    head(&mut scene, dice, [0.0, high - 0.02, level], half_width);

    if acoustic {
        let hole = Frame::at([0.0, 0.08 * length, thick]).turned(1, 2, 90.0);
        let mut dish = scene.cut(0.015);
        dish.disc(BODY, hole, dice.between(0.065, 0.085), 0.035, 0.02);
        dish = scene.limb(0.01, 0.0);
        let bridge = Frame::at([0.0, -0.24 * length, thick]);
        dish.block(BODY, bridge, [dice.between(0.07, 0.1), 0.028, 0.03], 0.02);
    } else {
        let bridge = Frame::at([0.0, -0.2 * length, thick]);
        scene
            .limb(0.01, 0.0)
            .block(BODY, bridge, [0.06, 0.035, 0.028], 0.02);
    }
    scene
}

fn head(scene: &mut Scene, dice: &mut Dice, at: [f64; 3], half_width: f64) {
    let long = dice.between(0.15, 0.22);
    let wide = half_width * dice.between(1.5, 2.1);
    let back = turn([0.0, 1.0, 0.0], [0.0, 0.0, -1.0], dice.between(2.0, 16.0));
    let frame = Frame::facing(at, back, [0.0, 0.0, 1.0]);
    let inner = half_width - 0.012;
    let one_sided = dice.chance(0.4);
    let side = if dice.chance(0.5) { -1.0 } else { 1.0 };
    let outline = if one_sided {
        vec![
            [-side * inner, 0.0],
            [side * inner, 0.0],
            [side * 0.8 * wide, 0.3 * long],
            [side * 0.7 * wide, long],
            [-side * 0.4 * inner, 1.08 * long],
            [-side * 0.9 * inner, 0.5 * long],
        ]
    } else {
        let top = dice.between(0.7, 1.1) * wide;
        vec![
            [-inner, 0.0],
            [inner, 0.0],
            [0.85 * wide, 0.28 * long],
            [top, long],
            [0.0, long * dice.between(0.96, 1.1)],
            [-top, long],
            [-0.85 * wide, 0.28 * long],
        ]
    };
    let plate = Solid::Plate {
        frame,
        outline,
        half: 0.004,
        round: 0.028,
    };
    let limb = scene.limb(0.01, 0.01);
    limb.solid(HEAD, plate);
    // Pegs, on one side or both.
    for i in 0..2 {
        let y = long * (0.42 + 0.5 * f64::from(i));
        let reach = wide + dice.between(0.05, 0.06);
        for s in [-1.0, 1.0] {
            if one_sided && s != side {
                continue;
            }
            let (from, to) = (frame.world([0.0, y, 0.0]), frame.world([s * reach, y, 0.0]));
            limb.cone(HEAD, from, to, 0.025, 0.027);
        }
    }
}

/// Mirrors an outline whose right half is given from the bottom up, in units of half the length.
fn mirrored(length: f64, right: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let h = length / 2.0;
    let mut points: Vec<[f64; 2]> = right.iter().map(|[x, y]| [x * h, y * h]).collect();
    let left = right
        .iter()
        .rev()
        .filter(|p| p[0] != 0.0)
        .map(|[x, y]| [-x * h, y * h]);
    points.extend(left);
    points
}

fn classical(dice: &mut Dice, length: f64) -> Vec<[f64; 2]> {
    let lower = dice.between(0.66, 0.82);
    let upper = lower * dice.between(0.7, 0.85);
    let waist = upper * dice.between(0.68, 0.85);
    let right = [
        [0.0, -1.0],
        [0.7 * lower, -0.9],
        [lower, -0.48],
        [0.9 * lower, -0.12],
        [waist, 0.2],
        [0.96 * upper, 0.5],
        [0.92 * upper, 0.8],
        [0.5 * upper, 0.98],
        [0.0, 1.0],
    ];
    mirrored(length, &right)
}

fn horned(dice: &mut Dice, length: f64) -> Vec<[f64; 2]> {
    let lower = dice.between(0.76, 0.92);
    let waist = lower * dice.between(0.62, 0.75);
    let h = length / 2.0;
    // One horn, or two of unequal length.
    let tips = [
        dice.between(1.05, 1.3),
        if dice.chance(0.6) {
            dice.between(0.96, 1.15)
        } else {
            0.55
        },
    ];
    let half = |tip: f64| {
        let mut points = vec![
            [0.7 * lower, -0.9],
            [lower, -0.5],
            [0.93 * lower, -0.15],
            [waist, 0.2],
        ];
        if tip > 0.9 {
            points.extend([
                [1.08 * waist, 0.55],
                [1.14 * waist, tip - 0.15],
                [0.98 * waist, tip],
                [0.74 * waist, tip - 0.1],
                [0.52 * waist, 0.76],
                [0.28, 0.66],
            ]);
        } else {
            points.extend([[0.96 * waist, 0.5], [0.6 * waist, 0.68]]);
        }
        points
    };
    let mut points = vec![[0.0, -h]];
    points.extend(half(tips[0]).iter().map(|[x, y]| [x * h, y * h]));
    points.push([0.0, 0.7 * h]);
    points.extend(half(tips[1]).iter().rev().map(|[x, y]| [-x * h, y * h]));
    points
}

fn arrow(dice: &mut Dice, length: f64) -> Vec<[f64; 2]> {
    let spread = dice.between(0.7, 0.95);
    let notch = dice.between(-0.45, -0.15);
    let tip = dice.between(0.2, 0.26);
    let right = [
        [0.0, notch],
        [0.28 * spread, notch - 0.28],
        [0.75 * spread - 0.5 * tip, -1.2],
        [0.75 * spread + 0.3 * tip, -1.28],
        [0.75 * spread + tip, -1.05],
        [0.55 * spread + 0.8 * tip, -0.4],
        [0.3, 0.55],
        [0.16, 0.95],
        [0.0, 1.0],
    ];
    mirrored(length, &right)
}

fn pear(dice: &mut Dice, length: f64) -> Vec<[f64; 2]> {
    let wide = dice.between(0.62, 0.85);
    let right = [
        [0.0, -1.0],
        [0.62 * wide, -0.88],
        [wide, -0.42],
        [0.92 * wide, 0.0],
        [0.62 * wide, 0.45],
        [0.32 * wide, 0.85],
        [0.0, 1.0],
    ];
    mirrored(length, &right)
}
