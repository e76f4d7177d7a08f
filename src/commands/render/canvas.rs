//! Draws pixels and text, and encodes them as PNG.

use font8x8::UnicodeFonts as _;
use std::io;

/// Width and height of a character in pixels.
pub(super) const GLYPH: usize = 8;

/// A picture, row by row, sRGB.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::commands) struct Canvas {
    width: usize,
    pixels: Vec<[u8; 3]>,
}

impl Canvas {
    /// Creates a white picture.
    pub(super) fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            pixels: vec![[255; 3]; width * height],
        }
    }

    /// Creates a picture from pixels row by row.
    pub(super) fn of_pixels(width: usize, pixels: Vec<[u8; 3]>) -> Self {
        Self { width, pixels }
    }

    pub(super) fn width(&self) -> usize {
        self.width
    }

    pub(super) fn height(&self) -> usize {
        self.pixels.len() / self.width.max(1)
    }

    /// Fills a rectangle, clipped to the picture.
    pub(super) fn fill(
        &mut self,
        x: usize,
        y: usize,
        width: usize,
        height: usize,
        colour: [u8; 3],
    ) {
        for row in y..(y + height).min(self.height()) {
            for column in x..(x + width).min(self.width) {
                self.pixels[row * self.width + column] = colour;
            }
        }
    }

    /// Copies another picture to a position, clipped to this picture.
    pub(super) fn put(&mut self, x: usize, y: usize, other: &Self) {
        for (i, &pixel) in other.pixels.iter().enumerate() {
            self.fill(x + i % other.width, y + i / other.width, 1, 1, pixel);
        }
    }

    /// Writes a line of text; a character that the font lacks becomes a question mark.
    pub(super) fn text(&mut self, x: usize, y: usize, text: &str, colour: [u8; 3]) {
        for (i, c) in text.chars().enumerate() {
            let fonts = [font8x8::BASIC_FONTS.get(c), font8x8::LATIN_FONTS.get(c)];
            let glyph = fonts.into_iter().flatten().next();
            let glyph = glyph
                .or_else(|| font8x8::BASIC_FONTS.get('?'))
                .unwrap_or_default();
            for (row, bits) in glyph.iter().enumerate() {
                for column in (0..GLYPH).filter(|b| bits >> b & 1 == 1) {
                    self.fill(x + i * GLYPH + column, y + row, 1, 1, colour);
                }
            }
        }
    }

    /// The picture as a PNG file.
    pub(in crate::commands) fn png(&self) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let size = |n: usize| u32::try_from(n).map_err(io::Error::other);
        let mut encoder = png::Encoder::new(&mut bytes, size(self.width)?, size(self.height())?);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header().map_err(io::Error::other)?;
        let written = writer.write_image_data(self.pixels.as_flattened());
        written
            .and_then(|()| writer.finish())
            .map_err(io::Error::other)?;
        Ok(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::Canvas;

    #[test]
    fn text_is_drawn_and_what_is_outside_left_out() {
        let mut canvas = Canvas::new(12, 8);
        canvas.text(0, 0, "I\u{1f600}", [0; 3]);
        let dark = |c: &Canvas| c.pixels.iter().filter(|p| **p == [0; 3]).count();
        assert!(dark(&canvas) > 15, "{}", dark(&canvas));
        canvas.fill(10, 6, 100, 100, [0; 3]);
        assert_eq!((canvas.width(), canvas.height()), (12, 8));
    }

    #[test]
    fn a_png_reads_back() {
        let mut canvas = Canvas::new(3, 2);
        canvas.fill(1, 1, 1, 1, [1, 2, 3]);
        let bytes = canvas.png().unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes))
            .read_info()
            .unwrap();
        let mut pixels = vec![0; 18];
        reader.next_frame(&mut pixels).unwrap();
        assert_eq!(pixels, canvas.pixels.as_flattened());
    }
}
