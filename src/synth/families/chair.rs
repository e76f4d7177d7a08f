//! Generates chairs: on four legs, a pedestal or runners; with a solid back, bars or rungs; with or
//! without arms.

use crate::synth::dice::Dice;
use crate::synth::field::Scene;
use crate::synth::solid::Solid;
use crate::synth::vector::{Frame, Vec3, along, closed_curve, mix, norm, sub, turn};

pub(in crate::synth) const LABELS: &[&str] = &["seat", "back", "leg", "arm"];
const SEAT: u32 = 0;
const BACK: u32 = 1;
const LEG: u32 = 2;
const ARM: u32 = 3;

/// The dimensions to which all parts are fitted.
struct Plan {
    /// Height of the middle of the seat.
    height: f64,
    /// Half width, half thickness, half depth of the seat.
    seat: Vec3,
    /// Radius of posts, bars and legs.
    rod: f64,
    /// Distance from the seat's edges at which the legs are under the seat.
    inset: f64,
    /// Half width and rear edge of the area that can support a back.
    rear: [f64; 2],
}

impl Plan {
    /// Height at which a ball of this radius does not show through the seat.
    fn under(&self, radius: f64) -> f64 {
        self.height + self.seat[1] - radius - 0.008
    }
}

pub(in crate::synth) fn scene(dice: &mut Dice) -> Scene {
    let mut scene = Scene::default();
    let round = dice.chance(0.33);
    let seat = [
        dice.between(0.21, 0.29),
        dice.between(0.033, 0.055),
        dice.between(0.2, 0.26),
    ];
    let plan = Plan {
        height: dice.between(0.38, 0.5),
        seat,
        rod: dice.between(0.03, 0.038),
        inset: if round { 0.095 } else { 0.06 },
        rear: if round {
            [0.8 * seat[0], 0.06 - seat[2]]
        } else {
            [seat[0], 0.035 - seat[2]]
        },
    };
    let [width, thick, depth] = plan.seat;
    let centre = Frame::at([0.0, plan.height, 0.0]);
    let limb = scene.limb(0.0, 0.0);
    if round {
        // A plate lies across its third axis, which points up after turning.
        let frame = centre.turned(1, 2, -90.0);
        let outline = rounded(width - 0.03, depth - 0.03);
        limb.solid(
            SEAT,
            Solid::Plate {
                frame,
                outline,
                half: thick - 0.03,
                round: 0.03,
            },
        );
    } else {
        limb.block(SEAT, centre, [width, thick, depth], 0.03);
    }
    let arms = dice.chance(0.45);
    let back = back(&mut scene, dice, &plan);
    match dice.pick(5) {
        0 => pedestal(&mut scene, dice, &plan),
        1 => runners(&mut scene, dice, &plan),
        _ => four_legs(&mut scene, dice, &plan),
    }
    if arms {
        arm_rests(&mut scene, dice, &plan, &back);
    }
    scene
}

/// A rectangle of these half sizes with strongly rounded corners.
fn rounded(x: f64, y: f64) -> Vec<[f64; 2]> {
    let c = 0.82;
    let points = [
        [x, 0.0],
        [c * x, c * y],
        [0.0, y],
        [-c * x, c * y],
        [-x, 0.0],
        [-c * x, -c * y],
        [0.0, -y],
        [c * x, -c * y],
    ];
    closed_curve(&points, 4)
}

/// The frame of the back: x across, y up along it, z forward, the origin on the seat.
fn back(scene: &mut Scene, dice: &mut Dice, plan: &Plan) -> Frame {
    let [width, edge] = plan.rear;
    let tall = dice.between(0.38, 0.62);
    let lean = dice.between(2.0, 16.0);
    let inset = width - plan.rod;
    let foot = [0.0, plan.height + 0.3 * plan.seat[1], edge];
    let up = turn([0.0, 1.0, 0.0], [0.0, 0.0, -1.0], lean);
    let frame = Frame::facing(foot, up, [0.0, 0.0, 1.0]);
    let at = |x: f64, y: f64| frame.world([x, y, 0.0]);
    let rod = plan.rod;
    let kind = dice.pick(4);
    if kind == 0 {
        // A panel that starts at the seat; its top is level or an arc.
        let arc = dice.between(0.0, 0.1);
        let w = width * dice.between(0.92, 1.0) - 0.03;
        let top = tall - 0.03;
        let outline = vec![
            [-w, 0.0],
            [w, 0.0],
            [w, top - arc],
            [0.7 * w, top - 0.45 * arc],
            [0.35 * w, top - 0.1 * arc],
            [0.0, top],
            [-0.35 * w, top - 0.1 * arc],
            [-0.7 * w, top - 0.45 * arc],
            [-w, top - arc],
        ];
        let half = dice.between(0.0, 0.012);
        scene.limb(0.025, 0.0).solid(
            BACK,
            Solid::Plate {
                frame,
                outline,
                half,
                round: 0.03,
            },
        );
        return frame;
    }
    let limb = scene.limb(0.02, 0.015);
    for side in [-1.0, 1.0] {
        limb.cone(
            BACK,
            at(side * inset, 0.0),
            at(side * inset, tall),
            rod,
            rod,
        );
    }
    match kind {
        1 => {
            // Bars between two rails, as many as leave gaps of more than their own width.
            let n = (2 + dice.pick(3)).min((2.0 * inset / 0.09) as usize - 1);
            let low = dice.between(0.08, 0.16);
            limb.cone(
                BACK,
                at(-inset, tall),
                at(inset, tall),
                1.15 * rod,
                1.15 * rod,
            );
            limb.cone(BACK, at(-inset, low), at(inset, low), rod, rod);
            for i in 1..=n {
                let x = inset * (2.0 * i as f64 / (n + 1) as f64 - 1.0);
                limb.cone(BACK, at(x, low), at(x, tall), 0.026, 0.026);
            }
        }
        2 => {
            // Rungs between the posts.
            let n = 2 + dice.pick(3);
            for i in 1..=n {
                let y = tall * i as f64 / n as f64 - if i == n { 0.04 } else { 0.06 };
                let rung = Frame {
                    origin: at(0.0, y),
                    ..frame
                };
                limb.block(
                    BACK,
                    rung,
                    [inset, dice.between(0.034, 0.045), 0.028],
                    0.026,
                );
            }
        }
        _ => {
            // A panel between the posts that leaves a gap above the seat.
            let gap = dice.between(0.12, 0.2);
            let middle = Frame {
                origin: at(0.0, (gap + tall) / 2.0),
                ..frame
            };
            limb.block(
                BACK,
                middle,
                [inset, (tall - gap) / 2.0 + 0.02, 0.032],
                0.03,
            );
        }
    }
    frame
}

fn four_legs(scene: &mut Scene, dice: &mut Dice, plan: &Plan) {
    let [width, _, depth] = plan.seat;
    let splay = dice.between(0.0, 0.07);
    let inset = plan.inset + dice.between(0.0, 0.03);
    let thick = plan.rod * dice.between(1.0, 1.25);
    let square = dice.chance(0.3);
    let corner = |x: f64, z: f64| -> [Vec3; 2] {
        let top = [
            x * (width - inset),
            plan.under(1.1 * thick),
            z * (depth - inset),
        ];
        let foot = [
            x * (width - inset + splay),
            0.0,
            z * (depth - inset + splay),
        ];
        [top, foot]
    };
    for (x, z) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
        let [top, foot] = corner(x, z);
        let limb = scene.limb(0.015, 0.0);
        if square {
            let y = [foot[0] - top[0], foot[1] - top[1], foot[2] - top[2]];
            let frame = Frame::facing(mix(top, foot, 0.5), y, [0.0, 0.0, 1.0]);
            limb.block(LEG, frame, [thick, norm(y) / 2.0, thick], 0.02);
        } else {
            limb.cone(LEG, top, foot, 1.1 * thick, thick * dice.between(0.8, 1.0));
        }
    }
    // Stretchers: none, on the sides, or all around; they belong to the legs.
    let (kind, level) = (dice.pick(4), dice.between(0.45, 0.75));
    let on = |x: f64, z: f64| {
        let [top, foot] = corner(x, z);
        mix(top, foot, level)
    };
    let limb = scene.limb(0.012, 0.012);
    let mut bar = |a: Vec3, b: Vec3| {
        limb.cone(LEG, a, b, 0.026, 0.026);
    };
    if kind == 1 || kind == 2 {
        bar(on(-1.0, -1.0), on(-1.0, 1.0));
        bar(on(1.0, -1.0), on(1.0, 1.0));
    }
    if kind == 1 {
        bar(
            mix(on(-1.0, -1.0), on(-1.0, 1.0), 0.5),
            mix(on(1.0, -1.0), on(1.0, 1.0), 0.5),
        );
    } else if kind == 2 {
        bar(on(-1.0, -1.0), on(1.0, -1.0));
        bar(on(-1.0, 1.0), on(1.0, 1.0));
    }
}

fn pedestal(scene: &mut Scene, dice: &mut Dice, plan: &Plan) {
    let column = dice.between(0.04, 0.055);
    let hub = [0.0, 0.09, 0.0];
    let limb = scene.limb(0.03, 0.03);
    limb.cone(LEG, [0.0, plan.under(column), 0.0], hub, column, column);
    let reach = dice.between(0.22, 0.3);
    if dice.chance(0.35) {
        limb.disc(LEG, Frame::at([0.0, 0.035, 0.0]), reach, 0.035, 0.03);
        limb.cone(LEG, hub, [0.0, 0.04, 0.0], column, column);
        return;
    }
    let n = 4 + dice.pick(2);
    let phase = dice.between(0.0, 90.0);
    for i in 0..n {
        let angle = phase + 360.0 * i as f64 / n as f64;
        let out = turn([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], angle);
        let foot = along([0.0, 0.04, 0.0], out, reach);
        limb.cone(LEG, hub, foot, 0.042, 0.034);
    }
}

fn runners(scene: &mut Scene, dice: &mut Dice, plan: &Plan) {
    let [width, _, depth] = plan.seat;
    let rod = plan.rod;
    let cantilever = dice.chance(0.5);
    let x = width - plan.inset;
    let (front, rear) = (depth - plan.inset, plan.inset - depth);
    let limb = scene.limb(0.015, 0.015);
    for side in [-x, x] {
        limb.cone(
            LEG,
            [side, plan.under(rod), front],
            [side, rod, front],
            rod,
            rod,
        );
        limb.cone(LEG, [side, rod, front], [side, rod, rear], rod, rod);
        if !cantilever {
            limb.cone(
                LEG,
                [side, plan.under(rod), rear],
                [side, rod, rear],
                rod,
                rod,
            );
        }
    }
    if cantilever {
        limb.cone(LEG, [-x, rod, rear], [x, rod, rear], rod, rod);
    }
}

fn arm_rests(scene: &mut Scene, dice: &mut Dice, plan: &Plan, back: &Frame) {
    let [width, _, depth] = plan.seat;
    let high = plan.height + dice.between(0.17, 0.25);
    let reach = depth * dice.between(0.45, 0.8);
    let board = dice.chance(0.5);
    let drop = dice.between(0.0, 0.03);
    let solid = dice.chance(0.25);
    for side in [-1.0, 1.0] {
        // The rest ends in the back, at the back's position at this height.
        let rise = (high + drop - back.origin[1]) / back.axes[1][1];
        let rear = back.world([side * (plan.rear[0] - plan.rod), rise, 0.0]);
        let front = [side * (width + 0.005), high, reach];
        let limb = scene.limb(0.015, 0.015);
        let ahead = sub(front, rear);
        let frame = Frame::facing(mix(rear, front, 0.5), ahead, [0.0, 1.0, 0.0]);
        let half = norm(ahead) / 2.0;
        if solid {
            // A side panel from seat to arm rest.
            let deep = (high - plan.height) / 2.0;
            let middle = Frame {
                origin: along(frame.origin, frame.axes[2], 0.03 - deep),
                ..frame
            };
            limb.block(ARM, middle, [0.036, half, deep], 0.03);
            continue;
        }
        if board {
            limb.block(ARM, frame, [0.044, half + 0.03, 0.028], 0.026);
        } else {
            limb.cone(ARM, rear, front, 0.033, 0.033);
        }
        let post = along(front, [0.0, 0.0, -1.0], 0.2 * reach);
        let seat = [side * (width - 0.03), plan.height, 0.5 * reach];
        limb.cone(ARM, post, seat, 0.029, 0.029);
    }
}
