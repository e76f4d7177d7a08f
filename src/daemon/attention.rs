//! Remembers which shapes pages show, so that these are relabelled first.

use std::collections::HashMap;
use std::time::{Duration, Instant};

/// Maximum number of shapes of one collection: more than fit on a screen.
pub(crate) const MAX_SHOWN: usize = 64;
/// Maximum number of collections that are remembered.
const MAX_COLLECTIONS: usize = 64;
/// What was shown for the last time before this is forgotten: pages ask every other second.
const AGE: Duration = Duration::from_secs(10);

/// The shapes that pages show, by collection.
#[derive(Debug, Default)]
pub(crate) struct Attention {
    shown: HashMap<String, (Instant, Vec<String>)>,
}

impl Attention {
    /// Notes that a page shows these shapes now, at most [`MAX_SHOWN`], in the order of their
    /// importance. The page that asked last counts.
    pub(crate) fn shows(&mut self, collection: &str, shapes: Vec<String>) {
        self.shown.retain(|_, (at, _)| at.elapsed() < AGE);
        let is_there = self.shown.contains_key(collection);
        if is_there || self.shown.len() < MAX_COLLECTIONS {
            let shown = (Instant::now(), shapes);
            self.shown.insert(collection.to_owned(), shown);
        }
    }

    /// The shapes of a collection that a page shows; none if no page has asked lately.
    pub(crate) fn of(&self, collection: &str) -> Vec<String> {
        let found = self.shown.get(collection);
        let found = found.filter(|(at, _)| at.elapsed() < AGE);
        found.map_or_else(Vec::new, |(_, shapes)| shapes.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::{Attention, MAX_COLLECTIONS};

    #[test]
    fn what_was_shown_last_counts_and_the_number_of_collections_is_bounded() {
        let mut attention = Attention::default();
        attention.shows("a", vec!["1".to_owned()]);
        attention.shows("a", vec!["2".to_owned()]);
        assert_eq!(attention.of("a"), ["2"]);
        assert_eq!(attention.of("b"), [""; 0]);
        for n in 0..2 * MAX_COLLECTIONS {
            attention.shows(&n.to_string(), vec![n.to_string()]);
        }
        assert_eq!(attention.shown.len(), MAX_COLLECTIONS);
        attention.shows("a", vec!["3".to_owned()]);
        assert_eq!(attention.of("a"), ["3"]);
    }
}
