//! Draws the random choices of one shape from a seed, the same on every machine.

use super::vector::Vec3;
use rand_pcg::Pcg64;
use rand_pcg::rand_core::RngCore;

/// Random numbers of one shape. They use the generator's raw output alone, since distributions of
/// other crates may change between versions.
pub(super) struct Dice(Pcg64);

impl Dice {
    /// `salt` separates the sequences that are drawn for one shape.
    pub(super) fn new(seed: u64, family: u64, index: u32, salt: u64) -> Self {
        // Each number is mixed into the state, since neighbouring seeds must not give similar
        // sequences.
        let low = mixed(mixed(seed) ^ mixed(family.wrapping_mul(3) + 1));
        let high = mixed(low ^ mixed(u64::from(index).wrapping_mul(5) + 2));
        let state = u128::from(high) << 64 | u128::from(low);
        Self(Pcg64::new(state, u128::from(mixed(high ^ salt))))
    }

    /// Uniform in [0, 1), a multiple of 2⁻⁵³.
    fn fraction(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in [low, high).
    pub(super) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.fraction()
    }

    /// True with this probability.
    pub(super) fn chance(&mut self, probability: f64) -> bool {
        self.fraction() < probability
    }

    /// Uniform in 0..n.
    pub(super) fn pick(&mut self, n: usize) -> usize {
        (self.fraction() * n as f64) as usize
    }

    /// The rows of a uniformly distributed rotation.
    pub(super) fn rotation(&mut self) -> [Vec3; 3] {
        // A uniform point of the unit ball of quaternions, by rejection.
        loop {
            let q = [0; 4].map(|_| self.between(-1.0, 1.0));
            let n: f64 = q.iter().map(|x| x * x).sum();
            if !(0.01..=1.0).contains(&n) {
                continue;
            }
            let s = 2.0 / n;
            let [w, x, y, z] = q;
            return [
                [
                    1.0 - s * (y * y + z * z),
                    s * (x * y - z * w),
                    s * (x * z + y * w),
                ],
                [
                    s * (x * y + z * w),
                    1.0 - s * (x * x + z * z),
                    s * (y * z - x * w),
                ],
                [
                    s * (x * z - y * w),
                    s * (y * z + x * w),
                    1.0 - s * (x * x + y * y),
                ],
            ];
        }
    }
}

/// SplitMix64's finaliser.
fn mixed(x: u64) -> u64 {
    let x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ x >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ x >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ x >> 31
}

#[cfg(test)]
mod tests {
    use super::Dice;
    use crate::synth::vector::{cross, dot, sub};

    #[test]
    fn the_sequence_is_fixed() {
        // A change here changes every generated shape, and thus the meaning of seeds in the docs.
        let mut dice = Dice::new(1, 0, 0, 0);
        let first: Vec<u64> = (0..3).map(|_| (dice.fraction() * 1e9) as u64).collect();
        assert_eq!(first, FIRST);
    }

    const FIRST: [u64; 3] = [52_147_413, 878_678_247, 928_749_997];

    #[test]
    fn is_uniform_and_differs_by_index() {
        let mut dice = Dice::new(7, 3, 1, 0);
        let mean = (0..10_000).map(|_| dice.between(2.0, 4.0)).sum::<f64>() / 10_000.0;
        // Standard error 2/sqrt(12)/100 = 0.006.
        assert!((mean - 3.0).abs() < 0.03, "{mean}");
        assert!((0..1000).all(|_| dice.pick(3) < 3));
        let mut other = Dice::new(7, 3, 2, 0);
        assert_ne!(dice.fraction(), other.fraction());
    }

    #[test]
    fn rotations_are_proper() {
        let mut dice = Dice::new(7, 3, 1, 0);
        for _ in 0..100 {
            let [a, b, c] = dice.rotation();
            assert!(dot(a, b).abs() < 1e-12 && (dot(a, a) - 1.0).abs() < 1e-12);
            let d = sub(cross(a, b), c);
            assert!(dot(d, d) < 1e-20);
        }
    }
}
