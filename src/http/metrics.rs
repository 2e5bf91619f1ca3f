//! Exports metrics in the Prometheus text format.
//!
//! The format is written by hand: a dozen metrics do not need a registry.

use std::fmt::{Display, Write as _};

use axum::extract::State;
use axum::http::header::{CONTENT_TYPE, HeaderName};

use crate::watch::status_store::{BUCKETS_S, Histogram, STAGES, StateCounts, StatusStore};

use super::Shared;

/// The response with all metrics.
pub(super) async fn metrics(State(state): Shared) -> ([(HeaderName, &'static str); 1], String) {
    ([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], exposition(&state.store))
}

fn exposition(store: &StatusStore) -> String {
    let (status, counts) = store.status();
    let counters = store.counters();
    let mut text = MetricsText(String::new());
    let version = concat!("version=\"", env!("CARGO_PKG_VERSION"), "\"");
    text.head("meniscus_build_info", "gauge", "Build information: the version is a label, the value is 1.");
    text.value("meniscus_build_info", version, 1);
    text.frames(&counts);
    let unavailable_count = status.unavailable.len() as u64;
    for (name, help, value) in [
        ("meniscus_queue_depth", "Frames in the queue.", Some(counts.queued as u64)),
        (
            "meniscus_paused",
            "1 while the daemon is paused: an output disk is full, not mounted, or refuses writes.",
            Some(u64::from(status.paused.is_some())),
        ),
        (
            "meniscus_unavailable_folders",
            "Watched and output folders that are unavailable.",
            Some(unavailable_count),
        ),
        (
            "meniscus_disk_free_bytes",
            "The least free space of all file systems of outputs.",
            status.disk_free_bytes,
        ),
        ("meniscus_resident_memory_bytes", "Resident memory of the process.", status.memory_bytes),
        ("meniscus_frames_converted_total", "Frames that were converted.", Some(counters.converted)),
        (
            "meniscus_frames_found_done_total",
            "Frames that were done when they were read.",
            Some(counters.found_done),
        ),
        ("meniscus_failures_total", "Failures that are not retried.", Some(counters.failures)),
        ("meniscus_retries_total", "Failures that are retried.", Some(counters.retries)),
        ("meniscus_scans_total", "Full scans of a watched folder.", Some(counters.scans)),
        ("meniscus_rescans_total", "Full scans because events were lost.", Some(counters.rescans)),
        ("meniscus_input_bytes_total", "Bytes of converted input files.", Some(counters.input_bytes)),
        ("meniscus_output_bytes_total", "Bytes of written outputs.", Some(counters.output_bytes)),
    ] {
        if let Some(value) = value {
            text.head(name, if name.ends_with("_total") { "counter" } else { "gauge" }, help);
            text.value(name, "", value);
        }
    }
    text.stages(&counters.stages);
    text.0
}

struct MetricsText(String);

impl MetricsText {
    fn head(&mut self, name: &str, kind: &str, help: &str) {
        // Writing to a string cannot fail.
        let _ = write!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}\n");
    }

    fn value(&mut self, name: &str, labels: &str, value: impl Display) {
        let _ = match labels {
            "" => writeln!(self.0, "{name} {value}"),
            labels => writeln!(self.0, "{name}{{{labels}}} {value}"),
        };
    }

    fn frames(&mut self, counts: &StateCounts) {
        self.head("meniscus_frames", "gauge", "Frames by state.");
        let StateCounts { waiting, queued, working, retrying, done, failed } = *counts;
        for (state, count) in [
            ("waiting", waiting),
            ("queued", queued),
            ("working", working),
            ("retrying", retrying),
            ("done", done),
            ("failed", failed),
        ] {
            self.value("meniscus_frames", &format!("state=\"{state}\""), count);
        }
    }

    fn stages(&mut self, stages: &[Histogram]) {
        const NAME: &str = "meniscus_stage_duration_seconds";
        self.head(NAME, "histogram", "Seconds that each converted frame spent in a stage.");
        for (stage, histogram) in STAGES.iter().zip(stages) {
            let mut count = 0;
            let ends = BUCKETS_S.iter().map(f64::to_string).chain(["+Inf".to_owned()]);
            for (end, in_bucket) in ends.zip(histogram.counts) {
                count += in_bucket;
                self.value(&format!("{NAME}_bucket"), &format!("stage=\"{stage}\",le=\"{end}\""), count);
            }
            self.value(&format!("{NAME}_sum"), &format!("stage=\"{stage}\""), histogram.sum);
            self.value(&format!("{NAME}_count"), &format!("stage=\"{stage}\""), count);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::watch::status_store::{Counters, Figures};

    #[test]
    fn buckets_are_cumulative() {
        let store = StatusStore::new();
        let mut figures = Figures::default();
        let mut counters = Counters::default();
        for seconds in [0.002, 2.0, 500.0] {
            figures.seconds.smooth = seconds;
            counters.add_converted(&figures, 10, 20);
        }
        store.set_counters(counters);
        let text = exposition(&store);
        for line in [
            "meniscus_frames{state=\"done\"} 0",
            "meniscus_frames_converted_total 3",
            "meniscus_output_bytes_total 60",
            "meniscus_stage_duration_seconds_bucket{stage=\"smooth\",le=\"0.003\"} 1",
            "meniscus_stage_duration_seconds_bucket{stage=\"smooth\",le=\"3\"} 2",
            "meniscus_stage_duration_seconds_bucket{stage=\"smooth\",le=\"+Inf\"} 3",
            "meniscus_stage_duration_seconds_sum{stage=\"smooth\"} 502.002",
            "meniscus_stage_duration_seconds_count{stage=\"read\"} 3",
        ] {
            assert!(text.lines().any(|other| other == line), "no {line} in\n{text}");
        }
    }

    #[test]
    fn every_metric_is_preceded_by_its_help_and_type() {
        let text = exposition(&StatusStore::new());
        let mut known = Vec::new();
        for line in text.lines() {
            match line.strip_prefix("# TYPE ") {
                Some(head) => known.push(head.split(' ').next().unwrap_or_default().to_owned()),
                None if line.starts_with("# HELP ") => {}
                None => {
                    let name = line.split(['{', ' ']).next().unwrap_or_default();
                    assert!(known.last().is_some_and(|head| name.starts_with(&**head)), "{line}");
                }
            }
        }
        assert!(text.ends_with('\n') && known.len() > 10);
    }
}
