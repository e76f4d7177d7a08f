//! Counts what the daemon does, for Prometheus at `/metrics` and for `coseg stats` and `coseg top`.
//!
//! `docs/metrics.md` lists them.

use crate::ipc::wire;
use crate::library::{LibraryStats, Outcome, Placed};
use prometheus_client::encoding::{EncodeLabelSet, text};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};
use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

/// Upper bounds of the histogram of stages, in seconds: most take milliseconds, a spectrum of a
/// large mesh seconds.
const STAGE_BOUNDS: [f64; 12] = [
    0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.5, 1.0, 3.0, 10.0, 60.0, 600.0,
];

type Labelled<L, M> = Family<L, M>;

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Stage {
    stage: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OutcomeLabel {
    outcome: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct State {
    state: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Refusal {
    code: &'static str,
    reason: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Task {
    task: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Page {
    path: &'static str,
    status: u16,
}

/// Values that are read for each scrape, not counted.
#[derive(Debug, Default)]
pub(crate) struct Now {
    pub(crate) library: LibraryStats,
    pub(crate) n_queued: usize,
    /// Jobs with a shape in work, and jobs that only wait.
    pub(crate) n_jobs: (usize, usize),
    pub(crate) at_stages: BTreeMap<String, usize>,
    pub(crate) memory_limit: u64,
    /// Reserved bytes, by purpose.
    pub(crate) memory_reserved: [(&'static str, u64); 4],
    pub(crate) resident_bytes: u64,
    pub(crate) workers: usize,
    pub(crate) uptime_secs: f64,
    pub(crate) requests_in_flight: usize,
    pub(crate) ready: bool,
}

/// Counters since the start, and gauges that are set when they are read.
pub(crate) struct Metrics {
    registry: Registry,
    stage_seconds: Labelled<Stage, Histogram>,
    finished: Labelled<OutcomeLabel, Counter>,
    pub(crate) relabelled: Counter,
    pub(crate) inconsistent: Counter,
    pub(crate) workers_died: Counter,
    pub(crate) events: Counter,
    pub(crate) replies: Counter,
    pub(crate) received_bytes: Counter,
    pub(crate) sent_bytes: Counter,
    refusals: Labelled<Refusal, Counter>,
    faults: Labelled<Task, Counter>,
    pages: Labelled<Page, Counter>,
    gauges: Gauges,
    /// Shapes and milliseconds by stage, in order of first appearance.
    stages: Mutex<Vec<(String, u64, f64)>>,
}

#[derive(Default)]
struct Gauges {
    collections: Gauge,
    shapes: Gauge,
    stale: Gauge,
    queued: Gauge,
    jobs: Labelled<State, Gauge>,
    at_stage: Labelled<Stage, Gauge>,
    stored: Gauge,
    catalog: Gauge,
    memory_limit: Gauge,
    reserved: Labelled<State, Gauge>,
    resident: Gauge,
    workers: Gauge,
    in_flight: Gauge,
    ready: Gauge,
    uptime: Gauge<f64, std::sync::atomic::AtomicU64>,
}

impl Gauges {
    fn register(&self, r: &mut Registry) {
        let g = self;
        r.register("ready", "1 if changes are accepted", g.ready.clone());
        r.register_with_unit("uptime", "Since the start", Unit::Seconds, g.uptime.clone());
        r.register("collections", "Collections", g.collections.clone());
        r.register("shapes", "Stored shapes", g.shapes.clone());
        r.register(
            "shapes_stale",
            "Stored shapes whose labels wait to be recomputed",
            g.stale.clone(),
        );
        r.register(
            "shapes_queued",
            "Accepted shapes that are not placed yet",
            g.queued.clone(),
        );
        r.register(
            "shapes_at_stage",
            "Shapes in work, by the stage they are at",
            g.at_stage.clone(),
        );
        r.register("jobs", "Jobs that are not finished", g.jobs.clone());
        r.register("workers", "Threads that describe shapes", g.workers.clone());
        r.register(
            "requests_in_hand",
            "Requests being answered or waiting for it",
            g.in_flight.clone(),
        );
    }

    fn register_bytes(&self, r: &mut Registry) {
        let g = self;
        let bytes = || Unit::Bytes;
        r.register_with_unit(
            "stored",
            "Array files and originals on disk",
            bytes(),
            g.stored.clone(),
        );
        r.register_with_unit("catalog", "The catalog on disk", bytes(), g.catalog.clone());
        r.register_with_unit(
            "memory_limit",
            "Memory for requests and work in hand",
            bytes(),
            g.memory_limit.clone(),
        );
        r.register_with_unit(
            "memory_reserved",
            "Memory reserved now, by what for",
            bytes(),
            g.reserved.clone(),
        );
        r.register_with_unit(
            "memory_resident",
            "Resident memory of the daemon",
            bytes(),
            g.resident.clone(),
        );
    }
}

fn gauge(n: u64) -> i64 {
    i64::try_from(n).unwrap_or(i64::MAX)
}

impl Metrics {
    pub(crate) fn new() -> Self {
        let metrics = Self {
            registry: Registry::default(),
            stage_seconds: Family::new_with_constructor(|| Histogram::new(STAGE_BOUNDS)),
            finished: Family::default(),
            relabelled: Counter::default(),
            inconsistent: Counter::default(),
            workers_died: Counter::default(),
            events: Counter::default(),
            replies: Counter::default(),
            received_bytes: Counter::default(),
            sent_bytes: Counter::default(),
            refusals: Family::default(),
            faults: Family::default(),
            pages: Family::default(),
            gauges: Gauges::default(),
            stages: Mutex::default(),
        };
        // Series that alerts use exist from the start, at 0.
        for outcome in ["added", "replaced", "unchanged", "failed", "cancelled"] {
            let _ = metrics.finished.get_or_create(&OutcomeLabel { outcome });
        }
        for task in ["place", "relabel", "publish", "sweep"] {
            let _ = metrics.faults.get_or_create(&Task { task });
        }
        metrics.registered()
    }

    fn registered(mut self) -> Self {
        let mut all = std::mem::take(&mut self.registry);
        let r = all.sub_registry_with_prefix("coseg");
        let version = vec![("version", env!("CARGO_PKG_VERSION"))];
        r.register("build", "The program", Info::new(version));
        self.gauges.register(r);
        self.gauges.register_bytes(r);
        self.register_counters(r);
        self.registry = all;
        self
    }

    fn register_counters(&self, r: &mut Registry) {
        r.register_with_unit(
            "stage_duration",
            "Time that shapes took in each stage",
            Unit::Seconds,
            self.stage_seconds.clone(),
        );
        r.register(
            "shapes_finished",
            "Shapes whose job came to an end, by outcome",
            self.finished.clone(),
        );
        r.register(
            "shapes_relabelled",
            "Stored shapes that got new labels in idle time",
            self.relabelled.clone(),
        );
        r.register(
            "maps_inconsistent",
            "Maps to new shapes that did not agree with the maps between the shapes they come from",
            self.inconsistent.clone(),
        );
        r.register(
            "workers_died",
            "Workers that ended over a shape or a request: aborted, out of memory",
            self.workers_died.clone(),
        );
        r.register("events", "Events published", self.events.clone());
        r.register(
            "replies",
            "Replies to requests, refusals included",
            self.replies.clone(),
        );
        r.register(
            "requests_refused",
            "Replies that were errors, by code and reason",
            self.refusals.clone(),
        );
        r.register_with_unit(
            "received",
            "Requests over ZeroMQ",
            Unit::Bytes,
            self.received_bytes.clone(),
        );
        r.register_with_unit(
            "sent",
            "Replies over ZeroMQ",
            Unit::Bytes,
            self.sent_bytes.clone(),
        );
        r.register(
            "background_errors",
            "Failures of catalog and store outside requests, by task",
            self.faults.clone(),
        );
        r.register(
            "http_responses",
            "Answers over HTTP, by path and status",
            self.pages.clone(),
        );
    }

    /// A shape was added, replaced, or found to be there.
    pub(crate) fn placed(&self, placed: &Placed) {
        let outcome = match placed.outcome {
            Outcome::Added => "added",
            Outcome::Replaced => "replaced",
            Outcome::Unchanged => "unchanged",
        };
        self.finished(outcome);
        self.inconsistent.inc_by(placed.n_inconsistent.into());
        let mut stages = self.stages.lock().unwrap_or_else(PoisonError::into_inner);
        for (stage, ms) in &placed.stages_ms {
            let label = Stage {
                stage: stage.clone(),
            };
            self.stage_seconds
                .get_or_create(&label)
                .observe(ms / 1_000.0);
            match stages.iter_mut().find(|s| s.0 == *stage) {
                Some(s) => (s.1, s.2) = (s.1 + 1, s.2 + ms),
                None => stages.push((stage.clone(), 1, *ms)),
            }
        }
    }

    /// A shape's job came to an end.
    pub(crate) fn finished(&self, outcome: &'static str) {
        self.finished.get_or_create(&OutcomeLabel { outcome }).inc();
    }

    /// Shapes placed since the start: added or replaced.
    pub(crate) fn n_placed(&self) -> u64 {
        let n = |outcome| self.finished.get_or_create(&OutcomeLabel { outcome }).get();
        n("added") + n("replaced")
    }

    /// A request was answered with an error.
    pub(crate) fn refused(&self, error: &wire::Error) {
        let code = error.code().as_str_name();
        let reason = error.reason().as_str_name();
        let label = Refusal {
            code: code.strip_prefix("ERROR_CODE_").unwrap_or(code),
            reason: reason.strip_prefix("ERROR_REASON_").unwrap_or(reason),
        };
        self.refusals.get_or_create(&label).inc();
    }

    /// Catalog or store failed outside a request.
    pub(crate) fn fault(&self, task: &'static str) {
        self.faults.get_or_create(&Task { task }).inc();
    }

    /// A page was served.
    pub(crate) fn page(&self, path: &'static str, status: u16) {
        self.pages.get_or_create(&Page { path, status }).inc();
    }

    /// The statistics of each stage, for the wire.
    pub(crate) fn stages(&self, now: &BTreeMap<String, usize>) -> Vec<wire::StageStats> {
        let stages = self.stages.lock().unwrap_or_else(PoisonError::into_inner);
        let n_now = |stage: &str| now.get(stage).map_or(0, |&n| n as u32);
        let mut all: Vec<_> = stages
            .iter()
            .map(|(stage, n_shapes, total_ms)| wire::StageStats {
                stage: stage.clone(),
                n_shapes: *n_shapes,
                total_ms: *total_ms,
                n_now: n_now(stage),
            })
            .collect();
        let unseen = now
            .keys()
            .filter(|stage| !stages.iter().any(|s| s.0 == **stage));
        all.extend(unseen.map(|stage| wire::StageStats {
            stage: stage.clone(),
            n_now: n_now(stage),
            ..wire::StageStats::default()
        }));
        all
    }

    /// All of it, in the text format of Prometheus (OpenMetrics 1.0).
    pub(crate) fn text(&self, now: &Now) -> String {
        let g = &self.gauges;
        let l = &now.library;
        g.collections.set(gauge(l.n_collections));
        g.shapes.set(gauge(l.n_shapes));
        g.stale.set(gauge(l.n_stale));
        g.queued.set(gauge(now.n_queued as u64));
        for (state, n) in [("working", now.n_jobs.0), ("waiting", now.n_jobs.1)] {
            g.jobs.get_or_create(&State { state }).set(gauge(n as u64));
        }
        g.at_stage.clear();
        for (stage, &n) in &now.at_stages {
            let label = Stage {
                stage: stage.clone(),
            };
            g.at_stage.get_or_create(&label).set(gauge(n as u64));
        }
        g.stored.set(gauge(l.stored_bytes));
        g.catalog.set(gauge(l.catalog_bytes));
        g.memory_limit.set(gauge(now.memory_limit));
        for (state, n) in now.memory_reserved {
            g.reserved.get_or_create(&State { state }).set(gauge(n));
        }
        g.resident.set(gauge(now.resident_bytes));
        g.workers.set(gauge(now.workers as u64));
        g.in_flight.set(gauge(now.requests_in_flight as u64));
        g.ready.set(i64::from(now.ready));
        g.uptime.set(now.uptime_secs);
        let mut out = String::new();
        text::encode(&mut out, &self.registry).expect("invariant: writing to a string succeeds");
        out
    }
}

#[cfg(test)]
mod tests {
    use super::{Metrics, Now};
    use crate::ipc::convert;
    use crate::ipc::wire::{ErrorCode, ErrorReason};
    use crate::library::{Outcome, Placed};

    #[test]
    fn counts_are_reported() {
        let metrics = Metrics::new();
        let placed = Placed {
            outcome: Outcome::Added,
            version: 1,
            sequence: 1,
            n_maps: 0,
            n_relabelled: 0,
            n_inconsistent: 1,
            stages_ms: vec![("spectrum".to_owned(), 40.0), ("place".to_owned(), 2.0)],
        };
        metrics.placed(&placed);
        metrics.placed(&placed);
        let code = ErrorCode::ResourceExhausted;
        metrics.refused(&convert::error(code, ErrorReason::QueueFull, "full"));
        metrics.fault("place");
        let mut now = Now {
            n_queued: 7,
            ..Now::default()
        };
        now.at_stages.insert("spectrum".to_owned(), 2);
        let text = metrics.text(&now);
        for line in [
            "coseg_shapes_queued 7",
            "coseg_shapes_at_stage{stage=\"spectrum\"} 2",
            "coseg_shapes_finished_total{outcome=\"added\"} 2",
            "coseg_shapes_finished_total{outcome=\"failed\"} 0",
            "coseg_stage_duration_seconds_bucket{le=\"0.1\",stage=\"spectrum\"} 2",
            "coseg_stage_duration_seconds_count{stage=\"place\"} 2",
            "coseg_requests_refused_total{code=\"RESOURCE_EXHAUSTED\",reason=\"QUEUE_FULL\"} 1",
            "coseg_background_errors_total{task=\"place\"} 1",
            "# EOF",
        ] {
            assert!(text.lines().any(|l| l == line), "no {line} in\n{text}");
        }
        // A stage that nobody is at any more is gone.
        assert!(
            !metrics
                .text(&Now::default())
                .contains("coseg_shapes_at_stage{")
        );
        let stages = metrics.stages(&now.at_stages);
        assert_eq!((stages[0].n_shapes, stages[0].n_now), (2, 2));
        assert_eq!((stages[1].total_ms, metrics.n_placed()), (4.0, 2));
    }
}
