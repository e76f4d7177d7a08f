//! Makes the viewer's HTML: live, or with all data inside.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use flate2::Compression;
use flate2::write::GzEncoder;
use serde_json::Value;
use std::io::Write as _;

/// The page, into which styles and scripts are inserted.
const FRAME: &str = include_str!("page/page.html");
/// The viewer's styles.
pub const STYLE: &str = include_str!("page/style.css");
/// The viewer's scripts, in the order in which they use each other.
const SCRIPTS: [&str; 27] = [
    include_str!("page/address.js"),
    include_str!("page/settings.js"),
    include_str!("page/data.js"),
    include_str!("page/mesh.js"),
    include_str!("page/pieces.js"),
    include_str!("page/draw.js"),
    include_str!("page/raster.js"),
    include_str!("page/gallery.js"),
    include_str!("page/toasts.js"),
    include_str!("page/legend.js"),
    include_str!("page/editor.js"),
    include_str!("page/strokes.js"),
    include_str!("page/painting.js"),
    include_str!("page/stage.js"),
    include_str!("page/pointer.js"),
    include_str!("page/painter.js"),
    include_str!("page/ask.js"),
    include_str!("page/proposals.js"),
    include_str!("page/links.js"),
    include_str!("page/changes.js"),
    include_str!("page/verdicts.js"),
    include_str!("page/actions.js"),
    include_str!("page/panel.js"),
    include_str!("page/live.js"),
    include_str!("page/keys.js"),
    include_str!("page/app.js"),
    include_str!("page/main.js"),
];

/// Returns the viewer's program.
pub fn script() -> String {
    SCRIPTS.join("\n")
}

/// Returns the page that the daemon serves beside `viewer.css` and `viewer.js`.
pub fn live() -> String {
    let style = r#"<link rel="stylesheet" href="viewer.css">"#;
    let script = r#"<script type="module" src="viewer.js"></script>"#;
    filled(style, "", script)
}

/// Content security policy of the page: it fetches nothing except from its own origin.
pub const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; \
                          connect-src 'self'; base-uri 'none'; form-action 'none'; \
                          frame-ancestors 'none'";
/// Content security policy of a page that is one file: it cannot fetch anything.
const SEALED: &str = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; \
                      img-src data:; base-uri 'none'; form-action 'none'";

fn filled(style: &str, data: &str, script: &str) -> String {
    FRAME
        .replace("<!--style-->", style)
        .replace("<!--data-->", data)
        .replace("<!--script-->", script)
}

/// Packs inside a page. Each is compressed on its own, so that the first shapes are drawn before
/// the last are read.
#[derive(Debug, Default)]
pub struct Embedded {
    elements: Vec<String>,
}

impl Embedded {
    /// Adds bytes under a kind (`portraits`, `functions`, `map`) and a key of letters and digits.
    ///
    /// # Errors
    /// Compression into memory does not fail; the error type is that of the writer.
    pub fn push(&mut self, kind: &str, key: &str, bytes: &[u8]) -> std::io::Result<()> {
        let mut gzip = GzEncoder::new(Vec::new(), Compression::best());
        gzip.write_all(bytes)?;
        let text = STANDARD.encode(gzip.finish()?);
        self.elements.push(format!(
            "<script type=\"application/octet-stream\" data-kind=\"{kind}\" \
             data-key=\"{key}\">{text}</script>"
        ));
        Ok(())
    }

    /// Returns the page with all that was added. `catalogue` lists it.
    pub fn page(&self, catalogue: &Value) -> String {
        // Only `<` could end the script element; its escape means the same in JSON.
        let json = catalogue.to_string().replace('<', "\\u003c");
        let mut data =
            format!("<script type=\"application/json\" id=\"catalogue\">{json}</script>\n");
        data.push_str(&self.elements.join("\n"));
        let style = format!(
            "<meta http-equiv=\"Content-Security-Policy\" content=\"{SEALED}\">\n\
             <style>{STYLE}</style>"
        );
        let script = format!("<script type=\"module\">{}</script>", script());
        filled(&style, &data, &script)
    }
}

#[cfg(test)]
mod tests {
    use super::{Embedded, FRAME, SCRIPTS, STYLE, live, script};
    use serde_json::json;

    #[test]
    fn a_page_needs_nothing_else() {
        let mut embedded = Embedded::default();
        embedded.push("portraits", "0", b"pack").unwrap();
        let name = "</script><script>alert(1)</script>";
        let page = embedded.page(&json!({ "name": name }));
        assert!(!page.contains("alert(1)</script>"));
        assert!(page.contains("data-kind=\"portraits\""));
        for element in [
            "<!--",
            "http://",
            "https://",
            " src=",
            "rel=\"stylesheet\"",
            "@import",
        ] {
            assert!(!page.contains(element), "{element}");
        }
        assert!(live().contains("viewer.js") && live().contains("viewer.css"));
    }

    #[test]
    fn names_are_only_ever_written_as_text() {
        for way in ["innerHTML", "insertAdjacentHTML", "document.write", "eval("] {
            assert!(!script().contains(way), "{way}");
        }
        assert_eq!(FRAME.matches("<!--").count(), 3);
        assert!(SCRIPTS.iter().all(|s| !s.contains("</script")) && !STYLE.contains("</style"));
    }
}
