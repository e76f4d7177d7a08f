//! `coseg top` displays queue, rates and stages of the daemon, and refreshes them periodically.

use super::session::{Session, print_line};
use super::{Outcome, stats};
use crate::cli::Top;
use coseg::call;
use coseg::ipc::wire::{StatsReply, StatsRequest};
use coseg::text::counted;
use coseg::text::table;
use std::fmt::Write as _;
use std::io::IsTerminal as _;
use std::time::Instant;

/// Clears the screen and moves to its upper left corner.
const CLEAR: &str = "\x1b[H\x1b[2J";
/// Length of the bar of a stage in characters.
const BAR: usize = 24;

pub(crate) fn run(args: &Top, mut session: Session) -> Outcome {
    let screen = std::io::stdout().is_terminal() && !session.json;
    let mut before: Option<(Instant, StatsReply)> = None;
    let mut n_looks = 0;
    loop {
        let now = call!(session.client, Stats(StatsRequest {}))?;
        let at = Instant::now();
        if session.json {
            session.print_json(&stats::json(&now))?;
        } else {
            // Counters of another daemon cannot be compared with those of this one.
            let before = before.as_ref().filter(|b| b.1.instance == now.instance);
            let since = before.map(|(then, stats)| (at.duration_since(*then).as_secs_f64(), stats));
            let text = picture(&now, since);
            print_line(&if screen {
                format!("{CLEAR}{text}")
            } else {
                text
            })?;
        }
        n_looks += 1;
        if args.limit.is_some_and(|limit| n_looks >= limit) {
            return Ok(true);
        }
        before = Some((at, now));
        std::thread::sleep(args.interval);
    }
}

/// The text of the display; it contains rates if an earlier reply is given, with the seconds since.
fn picture(now: &StatsReply, before: Option<(f64, &StatsReply)>) -> String {
    let rate = |of: fn(&StatsReply) -> u64| match before {
        Some((secs, then)) if secs > 0.0 => of(now).saturating_sub(of(then)) as f64 / secs,
        _ => of(now) as f64 / (now.uptime_ms as f64 / 1_000.0).max(1e-3),
    };
    let mut text = format!(
        "coseg {}  pid {}  up {}  {} workers{}\n\n",
        now.version,
        now.pid,
        duration(now.uptime_ms / 1_000),
        now.workers,
        if before.is_some() {
            ""
        } else {
            "  (rates since the start)"
        },
    );
    let line = |text: &mut String, name: &str, rest: String| {
        let _ = writeln!(text, "{name:<10}{rest}");
    };
    line(
        &mut text,
        "library",
        format!(
            "{} in {}, {} on disk",
            counted(now.n_shapes, "shape"),
            counted(now.n_collections, "collection"),
            bytes(now.stored_bytes + now.catalog_bytes)
        ),
    );
    line(
        &mut text,
        "queue",
        format!(
            "{} to place, {} to relabel",
            counted(now.n_queued, "shape"),
            now.n_stale
        ),
    );
    line(
        &mut text,
        "rates",
        format!(
            "{:.1} shapes/s placed, {:.1}/s relabelled, {:.1} events/s",
            rate(|s| s.n_placed),
            rate(|s| s.n_relabelled),
            rate(|s| s.n_events)
        ),
    );
    line(
        &mut text,
        "requests",
        format!(
            "{:.1}/s, {}/s in, {}/s out; {} refused, {} failed",
            rate(|s| s.n_requests),
            bytes(rate(|s| s.received_bytes) as u64),
            bytes(rate(|s| s.sent_bytes) as u64),
            now.n_refused,
            counted(now.n_failed, "shape")
        ),
    );
    line(
        &mut text,
        "memory",
        format!(
            "{} resident, {} of {} reserved",
            bytes(now.resident_bytes),
            bytes(now.memory_reserved_bytes),
            bytes(now.memory_limit_bytes)
        ),
    );
    let all: f64 = now.stages.iter().map(|s| s.total_ms).sum();
    let mut rows = vec![
        ["stage", "now", "shapes", "mean", "share"]
            .map(str::to_owned)
            .to_vec(),
    ];
    for s in &now.stages {
        let share = s.total_ms / all.max(1e-9);
        let mean = s.total_ms / s.n_shapes.max(1) as f64;
        rows.push(vec![
            s.stage.clone(),
            s.n_now.to_string(),
            s.n_shapes.to_string(),
            format!("{mean:.1} ms"),
            format!(
                "{} {:.0} %",
                "#".repeat((share * BAR as f64).round() as usize),
                share * 100.0
            ),
        ]);
    }
    if rows.len() > 1 {
        let _ = write!(text, "\n{}", table(&rows));
    }
    text.trim_end().to_owned()
}

fn duration(secs: u64) -> String {
    match secs {
        0..60 => format!("{secs} s"),
        60..3_600 => format!("{} min", secs / 60),
        _ => format!("{} h {} min", secs / 3_600, secs / 60 % 60),
    }
}

fn bytes(n: u64) -> String {
    let units = ["B", "kB", "MB", "GB", "TB"];
    let mut size = n as f64;
    let mut unit = 0;
    while size >= 999.5 && unit + 1 < units.len() {
        size /= 1_000.0;
        unit += 1;
    }
    let decimals = usize::from(unit > 0 && size < 99.95);
    format!("{size:.decimals$} {}", units[unit])
}

#[cfg(test)]
mod tests {
    use super::{bytes, duration, picture};
    use coseg::ipc::wire::{StageStats, StatsReply};

    #[test]
    fn rates_are_of_the_time_between_two_looks() {
        let stats = |n_placed| StatsReply {
            n_placed,
            uptime_ms: 10_000,
            stages: vec![StageStats {
                stage: "spectrum".to_owned(),
                n_shapes: 4,
                total_ms: 100.0,
                n_now: 2,
            }],
            ..StatsReply::default()
        };
        let text = picture(&stats(30), Some((2.0, &stats(20))));
        assert!(text.contains("5.0 shapes/s placed"), "{text}");
        let first = picture(&stats(30), None);
        assert!(first.contains("3.0 shapes/s placed") && first.contains("since the start"));
        let line = text.lines().find(|l| l.starts_with("spectrum")).unwrap();
        assert!(
            line.contains("25.0 ms") && line.ends_with("100 %"),
            "{line}"
        );
    }

    #[test]
    fn sizes_and_times_are_short() {
        assert_eq!(
            [0, 999, 1_000, 52_300_000].map(bytes),
            ["0 B", "999 B", "1.0 kB", "52.3 MB"]
        );
        assert_eq!(
            [59, 61, 7_300].map(duration),
            ["59 s", "1 min", "2 h 1 min"]
        );
    }
}
