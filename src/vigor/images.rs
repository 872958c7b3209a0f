//! Looking at image files: the header alone, or every pixel.

use serde::Serialize;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek};
use std::path::Path;

/// How closely images are looked at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verify {
    /// Only whether the file exists.
    None,
    /// The header: format, size, colours.
    #[default]
    Header,
    /// Every pixel is decoded.
    Full,
}

/// What an image must be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expected {
    /// Width and height in pixels, if they are fixed.
    pub size: Option<(u32, u32)>,
}

/// What is wrong with an image file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ImageProblem {
    /// The file cannot be read.
    #[error("cannot be read: {cause}")]
    Unreadable {
        /// What the system says.
        cause: String,
    },
    /// Neither PNG nor JPEG.
    #[error("is neither PNG nor JPEG (it starts with {start})")]
    Format {
        /// The first bytes, in hexadecimal.
        start: String,
    },
    /// The header is cut short or contradicts itself.
    #[error("has a broken header: {cause}")]
    Header {
        /// What is wrong.
        cause: &'static str,
    },
    /// Another size.
    #[error("is {width} x {height} pixels, not {expected_width} x {expected_height}")]
    Size {
        /// Width found.
        width: u32,
        /// Height found.
        height: u32,
        /// Width expected.
        expected_width: u32,
        /// Height expected.
        expected_height: u32,
    },
    /// Neither palette nor RGB with 8 bits.
    #[error("is {found}; expected a palette or 8-bit RGB")]
    Colour {
        /// What it is.
        found: &'static str,
    },
    /// The pixels do not decode: truncated or damaged.
    #[error("does not decode: {cause}")]
    Pixels {
        /// What the decoder says.
        cause: String,
    },
}

/// What a header says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Header {
    format: image::ImageFormat,
    width: u32,
    height: u32,
    colour: Colour,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Colour {
    /// Palette, or RGB with 8 bits.
    Good,
    Other(&'static str),
}

/// Checks one file as closely as `verify` asks. Whether it exists is up to the caller.
///
/// # Errors
/// [`ImageProblem`] for the first thing that is wrong.
pub fn check(path: &Path, verify: Verify, expected: Expected) -> Result<(), ImageProblem> {
    if verify == Verify::None {
        return Ok(());
    }
    let unreadable = |error: io::Error| ImageProblem::Unreadable { cause: error.to_string() };
    let mut file = BufReader::with_capacity(1 << 10, File::open(path).map_err(unreadable)?);
    let header = read_header(&mut file)?;
    if let Some((expected_width, expected_height)) = expected.size
        && (header.width, header.height) != (expected_width, expected_height)
    {
        let (width, height) = (header.width, header.height);
        return Err(ImageProblem::Size { width, height, expected_width, expected_height });
    }
    if let Colour::Other(found) = header.colour {
        return Err(ImageProblem::Colour { found });
    }
    if verify == Verify::Full {
        let bytes = std::fs::read(path).map_err(unreadable)?;
        image::load_from_memory_with_format(&bytes, header.format)
            .map_err(|error| ImageProblem::Pixels { cause: error.to_string() })?;
        // JPEG decoders fill in what is missing with grey.
        if header.format == image::ImageFormat::Jpeg && !jpeg_is_complete(&bytes) {
            return Err(ImageProblem::Pixels { cause: "the file ends before the image".into() });
        }
    }
    Ok(())
}

fn read_header(file: &mut (impl Read + Seek)) -> Result<Header, ImageProblem> {
    let mut start = Vec::with_capacity(8);
    file.take(8)
        .read_to_end(&mut start)
        .map_err(|error| ImageProblem::Unreadable { cause: error.to_string() })?;
    let header = match start.as_slice() {
        [0x89, b'P', b'N', b'G', 0x0D, 0x0A, 0x1A, 0x0A] => png_header(file),
        [0xFF, 0xD8, 0xFF, ..] => {
            // The third byte already belongs to the first marker.
            file.seek(io::SeekFrom::Start(2)).map_err(Broken::from).and_then(|_| jpeg_header(file))
        }
        [] => Err(Broken::Cause("the file is empty")),
        other => {
            let start = other.iter().map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" ");
            return Err(ImageProblem::Format { start });
        }
    };
    header.map_err(|broken| match broken {
        Broken::Cause(cause) => ImageProblem::Header { cause },
        Broken::Io(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
            ImageProblem::Header { cause: "the file ends inside it" }
        }
        Broken::Io(error) => ImageProblem::Unreadable { cause: error.to_string() },
    })
}

enum Broken {
    Cause(&'static str),
    Io(io::Error),
}

impl From<io::Error> for Broken {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// The IHDR chunk (PNG specification, section 11.2.2), checksum included.
fn png_header(file: &mut impl Read) -> Result<Header, Broken> {
    let mut chunk = [0_u8; 25];
    file.read_exact(&mut chunk)?;
    if chunk[..8] != [0, 0, 0, 13, b'I', b'H', b'D', b'R'] {
        return Err(Broken::Cause("it does not start with IHDR"));
    }
    if be_u32(&chunk[21..25]) != crc32fast::hash(&chunk[4..21]) {
        return Err(Broken::Cause("the checksum of IHDR is wrong"));
    }
    let colour = match (chunk[17], chunk[16]) {
        (2, 8) | (3, 1 | 2 | 4 | 8) => Colour::Good,
        (0, _) => Colour::Other("greyscale"),
        (4, _) => Colour::Other("greyscale with alpha"),
        (6, _) => Colour::Other("RGB with alpha"),
        (2, 16) => Colour::Other("16-bit RGB"),
        _ => return Err(Broken::Cause("the colour type does not exist")),
    };
    let (width, height) = (be_u32(&chunk[8..12]), be_u32(&chunk[12..16]));
    if width == 0 || height == 0 {
        return Err(Broken::Cause("the image has no pixels"));
    }
    Ok(Header { format: image::ImageFormat::Png, width, height, colour })
}

/// Walks the segments of a JPEG file up to the frame header (ITU-T T.81, B.2.2).
fn jpeg_header(file: &mut (impl Read + Seek)) -> Result<Header, Broken> {
    loop {
        let mut byte = [0_u8; 1];
        file.read_exact(&mut byte)?;
        if byte[0] != 0xFF {
            return Err(Broken::Cause("a JPEG marker is missing"));
        }
        // Any number of fill bytes may precede a marker.
        while byte[0] == 0xFF {
            file.read_exact(&mut byte)?;
        }
        let marker = byte[0];
        match marker {
            // TEM and restart markers stand alone.
            0x01 | 0xD0..=0xD7 => continue,
            0xD9 | 0xDA => return Err(Broken::Cause("there is no frame header before the data")),
            _ => {}
        }
        let mut length = [0_u8; 2];
        file.read_exact(&mut length)?;
        let length = u16::from_be_bytes(length);
        if length < 2 {
            return Err(Broken::Cause("a segment has no length"));
        }
        // C4, C8 and CC share the range of frame headers and are none.
        if matches!(marker, 0xC0..=0xCF) && !matches!(marker, 0xC4 | 0xC8 | 0xCC) {
            let mut frame = [0_u8; 6];
            file.read_exact(&mut frame)?;
            let height = u32::from(u16::from_be_bytes([frame[1], frame[2]]));
            let width = u32::from(u16::from_be_bytes([frame[3], frame[4]]));
            let colour = match (frame[0], frame[5]) {
                (8, 3) => Colour::Good,
                (_, 1) => Colour::Other("greyscale"),
                (_, 4) => Colour::Other("CMYK"),
                _ => Colour::Other("not 8-bit RGB"),
            };
            if width == 0 || height == 0 {
                return Err(Broken::Cause("the image has no pixels"));
            }
            return Ok(Header { format: image::ImageFormat::Jpeg, width, height, colour });
        }
        file.seek_relative(i64::from(length) - 2)?;
    }
}

/// Whether the end-of-image marker follows the scans. (One may also stand in the thumbnail of an
/// EXIF segment, so it is not enough to find it anywhere.)
fn jpeg_is_complete(bytes: &[u8]) -> bool {
    let mut at = 2;
    while let Some(&[marker, code]) = bytes.get(at..at + 2) {
        match (marker, code) {
            (0xFF, 0xD9) => return true,
            // Data of a scan: anything that is no marker, a stuffed zero, fill, a restart.
            (0xFF, 0x00 | 0x01 | 0xD0..=0xD7) => at += 2,
            (0xFF, 0xFF) | (0..0xFF, _) => at += 1,
            (0xFF, _) => {
                let Some(&[high, low]) = bytes.get(at + 2..at + 4) else { return false };
                at += 2 + usize::from(u16::from_be_bytes([high, low]));
            }
        }
    }
    false
}

fn be_u32(bytes: &[u8]) -> u32 {
    bytes.iter().fold(0, |value, byte| value << 8 | u32::from(*byte))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ExtendedColorType, ImageEncoder};
    use std::io::Cursor;

    const FREE: Expected = Expected { size: None };

    fn png(width: u32, height: u32, colour: ExtendedColorType) -> Vec<u8> {
        let n = (width * height * u32::from(colour.bits_per_pixel()) / 8) as usize;
        let pixels: Vec<u8> = (0..n).map(|i| (i * 7 % 251) as u8).collect();
        let mut out = Vec::new();
        image::codecs::png::PngEncoder::new(&mut out)
            .write_image(&pixels, width, height, colour)
            .expect("encodes");
        out
    }

    fn jpeg(width: u32, height: u32) -> Vec<u8> {
        let pixels = vec![100; (3 * width * height) as usize];
        let mut out = Vec::new();
        image::codecs::jpeg::JpegEncoder::new(&mut out)
            .write_image(&pixels, width, height, ExtendedColorType::Rgb8)
            .expect("encodes");
        out
    }

    fn check_bytes(bytes: &[u8], verify: Verify, expected: Expected) -> Result<(), ImageProblem> {
        let file = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(file.path(), bytes).expect("writes");
        check(file.path(), verify, expected)
    }

    #[test]
    fn good_images_pass_every_check() {
        for bytes in [png(40, 30, ExtendedColorType::Rgb8), jpeg(40, 30)] {
            for verify in [Verify::None, Verify::Header, Verify::Full] {
                assert_eq!(check_bytes(&bytes, verify, Expected { size: Some((40, 30)) }), Ok(()));
            }
        }
    }

    #[test]
    fn size_and_colours_are_told() {
        let rgb = png(40, 30, ExtendedColorType::Rgb8);
        let error = check_bytes(&rgb, Verify::Header, Expected { size: Some((640, 640)) });
        assert_eq!(error.expect_err("the size").to_string(), "is 40 x 30 pixels, not 640 x 640");
        for (colour, found) in [
            (ExtendedColorType::L8, "greyscale"),
            (ExtendedColorType::La8, "greyscale with alpha"),
            (ExtendedColorType::Rgba8, "RGB with alpha"),
            (ExtendedColorType::Rgb16, "16-bit RGB"),
        ] {
            assert_eq!(
                check_bytes(&png(4, 4, colour), Verify::Header, FREE),
                Err(ImageProblem::Colour { found })
            );
        }
    }

    #[test]
    fn a_truncated_file_passes_the_header_check_and_fails_the_full_one() {
        for bytes in [png(64, 64, ExtendedColorType::Rgb8), jpeg(640, 640)] {
            for length in [bytes.len() * 2 / 3, bytes.len() - 15] {
                let cut = &bytes[..length];
                assert_eq!(check_bytes(cut, Verify::Header, FREE), Ok(()));
                let error = check_bytes(cut, Verify::Full, FREE);
                assert!(matches!(error, Err(ImageProblem::Pixels { .. })), "{length}: {error:?}");
            }
        }
    }

    #[test]
    fn every_cut_and_every_flipped_byte_of_a_header_is_caught_or_harmless() {
        let good = png(9, 9, ExtendedColorType::Rgb8);
        for cut in 0..33 {
            assert!(check_bytes(&good[..cut], Verify::Header, FREE).is_err(), "cut to {cut}");
        }
        for at in 0..33 {
            let mut bad = good.clone();
            bad[at] ^= 0x10;
            assert!(check_bytes(&bad, Verify::Header, FREE).is_err(), "byte {at}");
        }
        let good = jpeg(16, 16);
        for cut in 0..good.len() {
            // Whatever the result, it is one.
            let _ = read_header(&mut Cursor::new(&good[..cut]));
        }
    }

    #[test]
    fn other_files_are_named() {
        assert!(matches!(
            check_bytes(b"GIF89a...", Verify::Header, FREE),
            Err(ImageProblem::Format { start }) if start.starts_with("47 49 46")
        ));
        assert_eq!(
            check_bytes(b"", Verify::Header, FREE),
            Err(ImageProblem::Header { cause: "the file is empty" })
        );
        let missing = check(Path::new("/no/such/file.png"), Verify::Header, FREE);
        assert!(matches!(missing, Err(ImageProblem::Unreadable { .. })));
    }
}
