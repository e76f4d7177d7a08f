//! Collections become a page to look at: live, served by the daemon, or one HTML file that needs nothing else.
//!
//! [`Pack`] holds arrays, [`portrait`] says which, [`page`] is the HTML. The page itself is `src/viewer/page`: plain
//! HTML, CSS and JavaScript, joined here, with no library and no build step. docs/viewer.md says what it shows.

mod pack;
pub mod page;
pub mod portrait;

pub use pack::Pack;
pub use page::Embedded;
pub use portrait::PortraitError;
