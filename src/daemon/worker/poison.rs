//! Faults that a test's mesh asks for in a comment, to test the isolation of workers.

use crate::daemon::operation::{Compute, Edit, Remote};
use std::time::Duration;

/// If it is set for the daemon, a comment `poison: abort` (or panic, loop, alloc, grow, reserve,
/// stack) in a mesh does as it says while the shape is described, `poison: abort-placing` (and so
/// on) while it is placed, and `poison: abort-answering` while a request that names the shape is
/// answered, in the worker. `slow` goes on after some seconds, `reserve` with address space that it
/// does not use. For tests of the isolation; no client can set it.
pub const POISON_VARIABLE: &str = "COSEG_TEST_POISON";
/// Bytes that growing poison takes at most, far beyond the limit of any work: without a watching
/// daemon the machine survives.
const GROWN: usize = 4 << 30;
/// Bytes that reserving poison takes: more than a small shape may hold.
const RESERVED: usize = 8 << 30;
/// The time that slow poison takes.
const SLOW: Duration = Duration::from_secs(2);
/// Bytes at the beginning of a mesh in which poison is looked for.
const POISON_BYTES: usize = 256;

/// The shapes that remote work names, in whose meshes poison is looked for.
pub(super) fn named_shapes(work: &Remote) -> Vec<&str> {
    match work {
        Remote::Compute(Compute::GetSpectrum(r)) => vec![&r.shape],
        Remote::Compute(Compute::GetHks(r)) => vec![&r.shape],
        Remote::Compute(Compute::GetFunctionalMap(r)) => vec![&r.from, &r.to],
        Remote::Compute(Compute::TransferFunction(r)) => vec![&r.from, &r.to],
        Remote::Compute(Compute::GetPartCorrespondence(r)) => vec![&r.shape_a, &r.shape_b],
        Remote::Compute(Compute::Nearest(r)) => vec![&r.shape],
        Remote::Compute(Compute::GetPortraits(r)) => r.shapes.iter().map(String::as_str).collect(),
        Remote::Edit(Edit::CorrectLabels(r)) => vec![&r.shape],
        Remote::Edit(Edit::RemoveShape(r)) => vec![&r.shape],
        Remote::Compute(
            Compute::SuggestNext(_)
            | Compute::NextQuestion(_)
            | Compute::ListProposals(_)
            | Compute::GetProposal(_),
        )
        | Remote::Edit(_) => Vec::new(),
    }
}

/// Commits the fault that a test's mesh asks for in a comment, if it is for the time `when`.
pub(super) fn take_poison(bytes: &[u8], when: &str) {
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(POISON_BYTES)]);
    let Some((_, poison)) = text.split_once("poison: ") else {
        return;
    };
    let poison = poison.split_whitespace().next().unwrap_or_default();
    let Some(poison) = poison.strip_suffix(when) else {
        return;
    };
    match poison {
        "panic" => panic!("poisoned"),
        "abort" => std::process::abort(),
        "loop" => loop {
            std::hint::spin_loop();
        },
        "alloc" => {
            let much = vec![1_u8; 100 << 30];
            std::hint::black_box(&much);
        }
        "grow" => grow(),
        "reserve" => {
            let much: Vec<u8> = Vec::with_capacity(RESERVED);
            std::mem::forget(std::hint::black_box(much));
        }
        "slow" => std::thread::sleep(SLOW),
        "stack" => {
            std::hint::black_box(deeper(1));
        }
        _ => {}
    }
}

/// Takes memory at no more than a MiB in a millisecond, so that the excess over a limit shows how
/// late the daemon noticed.
fn grow() {
    let mut taken = Vec::new();
    while taken.len() < GROWN >> 20 {
        taken.push(std::hint::black_box(vec![1_u8; 1 << 20]));
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Never returns.
fn deeper(depth: u64) -> u64 {
    let here = std::hint::black_box([depth; 512]);
    if here[0] == u64::MAX {
        return 0;
    }
    deeper(depth + 1).wrapping_add(here[511])
}
