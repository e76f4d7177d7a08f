//! Collections become a page: live, served by the daemon, or one HTML file that needs nothing else.
//!
//! [`Pack`] holds arrays, [`portrait`] selects them, and [`page`] makes the HTML. The page itself
//! is in `src/viewer/page`: plain HTML, CSS and JavaScript without a library or a build step,
//! joined here. docs/viewer.md describes what it shows.

mod pack;
pub mod page;
pub mod portrait;

pub use pack::Pack;
pub use page::Embedded;
pub use portrait::PortraitError;
