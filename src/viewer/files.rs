//! Files of the folder: which may be read, what they are called in MIME, and parts of them.

use super::Contents;
use percent_encoding::percent_decode_str;
use std::fs::{self, File};
use std::path::Path;

/// A file below the root, opened.
pub(super) struct Found {
    pub file: File,
    /// Its size when it was opened, bytes.
    pub length: u64,
    pub mime: &'static str,
}

/// The file at a percent-encoded path relative to the root, or none: absent, hidden, outside the root (by `..` or
/// by a link), not a regular file, or not among what was asked for.
pub(super) fn find(contents: &Contents, encoded: &str) -> Option<Found> {
    let relative = percent_decode_str(encoded).decode_utf8().ok()?;
    // On Windows a backslash would part folders and a colon would name a drive or a stream.
    if relative.contains(['\0', '\\']) || (cfg!(windows) && relative.contains(':')) {
        return None;
    }
    // An empty part is `//` or a path from the root of the file system; `.` and `..` begin like hidden names.
    if relative.split('/').any(|part| part.is_empty() || part.starts_with('.')) {
        return None;
    }
    if !contents.allows(&relative) {
        return None;
    }
    let real = fs::canonicalize(contents.root().join(relative.as_ref())).ok()?;
    // Before opening: to open a pipe is to wait for its other end.
    if !real.starts_with(contents.root()) || !fs::metadata(&real).ok()?.is_file() {
        return None;
    }
    let file = File::open(&real).ok()?;
    let length = file.metadata().ok()?.len();
    Some(Found { file, length, mime: mime(&relative) })
}

/// The MIME type of a file by its ending.
fn mime(name: &str) -> &'static str {
    let ending = Path::new(name).extension().and_then(|ending| ending.to_str()).unwrap_or_default();
    match ending.to_ascii_lowercase().as_str() {
        "glb" => "model/gltf-binary",
        "gltf" => "model/gltf+json",
        "json" => "application/json",
        "geojson" => "application/geo+json",
        "png" => "image/png",
        "jpg" | "jpeg" => "image/jpeg",
        "webp" => "image/webp",
        "gif" => "image/gif",
        "tif" | "tiff" => "image/tiff",
        "html" | "htm" => "text/html; charset=utf-8",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "txt" | "md" | "log" => "text/plain; charset=utf-8",
        "csv" => "text/csv; charset=utf-8",
        _ => "application/octet-stream",
    }
}

/// What a `Range` header asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    /// Everything: no range, or one that need not be heeded (several ranges, another unit, nonsense).
    Whole,
    /// Bytes from `start` on, `length` of them (at least one).
    Bytes { start: u64, length: u64 },
    /// Nothing that the file has.
    Outside,
}

/// Reads a `Range` header (RFC 9110, section 14.1.2) for a file of `length` bytes.
pub(super) fn part(header: Option<&str>, length: u64) -> Part {
    let number = |text: &str| {
        // `parse` would take a sign; a number too large for it is past any file's end.
        let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
        digits.then(|| text.parse().unwrap_or(u64::MAX))
    };
    let Some((first, last)) = header
        .and_then(|text| text.strip_prefix("bytes="))
        .and_then(|text| text.split_once('-'))
        .map(|(first, last)| (first.trim(), last.trim()))
    else {
        return Part::Whole;
    };
    let (start, end) = match (number(first), number(last)) {
        (Some(first), Some(last)) if first <= last => (first, last.saturating_add(1).min(length)),
        (Some(first), None) if last.is_empty() => (first, length),
        (None, Some(last)) if first.is_empty() => (length.saturating_sub(last), length),
        _ => return Part::Whole,
    };
    if start < end { Part::Bytes { start, length: end - start } } else { Part::Outside }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_those_of_the_standard() {
        let bytes = |start, length| Part::Bytes { start, length };
        for (header, expected) in [
            ("bytes=0-0", bytes(0, 1)),
            ("bytes=2-5", bytes(2, 4)),
            ("bytes=2-", bytes(2, 8)),
            ("bytes=2-99", bytes(2, 8)),
            ("bytes=9-99999999999999999999999", bytes(9, 1)),
            ("bytes=-3", bytes(7, 3)),
            ("bytes=-30", bytes(0, 10)),
            ("bytes=10-", Part::Outside),
            ("bytes=-0", Part::Outside),
            ("bytes=99999999999999999999999-", Part::Outside),
            ("bytes=5-2", Part::Whole),
            ("bytes=-", Part::Whole),
            ("bytes=+1-2", Part::Whole),
            ("bytes=0-1,3-4", Part::Whole),
            ("lines=0-1", Part::Whole),
            ("", Part::Whole),
        ] {
            assert_eq!(part(Some(header), 10), expected, "{header}");
        }
        assert_eq!(part(None, 10), Part::Whole);
        assert_eq!(part(Some("bytes=0-"), 0), Part::Outside);
    }

    #[test]
    fn endings_name_types_whatever_their_case() {
        assert_eq!(mime("a/b.GLB"), "model/gltf-binary");
        assert_eq!(mime("a.b/tileset.json"), "application/json");
        assert_eq!(mime("a.tif"), "image/tiff");
        assert_eq!(mime("glb"), "application/octet-stream");
    }
}
