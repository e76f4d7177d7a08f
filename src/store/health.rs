//! Makes the store read-only for the rest of the process after one failed sync.
//!
//! After a failed `fsync` the kernel may have dropped the pages and marked them clean, so a second
//! `fsync` that succeeds proves nothing (PostgreSQL's "fsyncgate"). The only honest answer is to
//! refuse further writes, to keep serving durable data, and to report the failure.

use super::StoreError;
use std::sync::{Arc, OnceLock};
use std::time::{SystemTime, UNIX_EPOCH};

/// The state that all writers share; writable until the first failed sync.
#[derive(Debug, Clone, Default)]
pub struct Health(Arc<OnceLock<Stop>>);

#[derive(Debug)]
struct Stop {
    since: String,
    cause: String,
}

impl Health {
    /// Returns an error once writes are refused.
    pub fn writable(&self) -> Result<(), StoreError> {
        match self.0.get() {
            None => Ok(()),
            Some(Stop { since, cause }) => Err(StoreError::ReadOnly {
                since: since.clone(),
                cause: cause.clone(),
            }),
        }
    }

    /// The time and the cause of the failure; `None` while writes are accepted.
    pub fn read_only(&self) -> Option<(&str, &str)> {
        self.0
            .get()
            .map(|stop| (stop.since.as_str(), stop.cause.as_str()))
    }

    /// Refuses all writes from now on, and returns the corresponding error.
    pub(crate) fn stop(&self, cause: String) -> StoreError {
        let stop = self.0.get_or_init(|| Stop {
            since: utc(SystemTime::now()),
            cause,
        });
        StoreError::ReadOnly {
            since: stop.since.clone(),
            cause: stop.cause.clone(),
        }
    }
}

/// Formats a time as RFC 3339 in UTC. The date is Hinnant's `civil_from_days`.
fn utc(time: SystemTime) -> String {
    let secs = time.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let (days, rest) = (secs / 86_400 + 719_468, secs % 86_400);
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era =
        (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted_month + 2) / 5 + 1;
    let month = if shifted_month < 10 {
        shifted_month + 3
    } else {
        shifted_month - 9
    };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    let (hour, minute, second) = (rest / 3_600, rest / 60 % 60, rest % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn the_first_cause_stays() {
        let health = Health::default();
        assert!(health.writable().is_ok());
        let other = health.clone();
        other.stop("fsync a: EIO".into());
        health.stop("fsync b: EIO".into());
        let error = health.writable().expect_err("stopped");
        assert!(error.to_string().contains("fsync a: EIO"), "{error}");
    }

    #[test]
    fn dates_are_civil() {
        let at = |secs| utc(UNIX_EPOCH + Duration::from_secs(secs));
        assert_eq!(at(0), "1970-01-01T00:00:00Z");
        assert_eq!(at(951_782_400), "2000-02-29T00:00:00Z");
        assert_eq!(at(4_102_444_799), "2099-12-31T23:59:59Z");
    }
}
