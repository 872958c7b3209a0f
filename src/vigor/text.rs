//! Label files, split files and image lists: from bytes to records, reporting every bad line.
//!
//! Three formats, fields separated by white space:
//! * labels (VIGOR, SliceMatch): `panorama`, then four times `satellite d0 d1`;
//! * splits (Sat3DGen): `satellite panorama sky_mask h w`, or the first three fields alone;
//! * lists: one satellite image per line.
//!
//! Real files mix CRLF and LF, lack a final line end, or start with a byte order mark.

use super::problem::{Problem, ProblemKind, quoted};
use serde::Serialize;
use std::collections::HashMap;
use std::collections::hash_map::Entry;

/// What a text file holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// Four satellite images per panorama, with offsets (13 fields).
    Labels,
    /// One satellite image per panorama (3 or 5 fields).
    Split,
    /// Names of satellite images (1 field).
    List,
}

/// One satellite image of a record.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct RawPair<'a> {
    /// Name, perhaps with folders.
    pub satellite: &'a str,
    /// Number of the field that holds the name, from 1.
    pub field: u32,
    /// `d0`, `d1`: pixels that the panorama lies south and west of the image's centre.
    pub offset: Option<[f64; 2]>,
}

/// A line that has the form of its format; names are not parsed yet.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Record<'a> {
    /// Line, from 1.
    pub line: u32,
    /// Name, perhaps with folders, and its field, from 1. None in a list.
    pub panorama: Option<(&'a str, u32)>,
    /// Third field of a split.
    pub sky_mask: Option<&'a str>,
    /// Satellite images, the positive first.
    pub pairs: Vec<RawPair<'a>>,
}

/// What a file says.
#[derive(Debug, Default)]
pub(super) struct Parsed<'a> {
    pub format: Option<Format>,
    pub lines: u32,
    pub blank: u32,
    pub records: Vec<Record<'a>>,
    pub problems: Vec<Problem>,
}

/// Fields of a label line.
const LABEL_FIELDS: usize = 13;

/// Parses the text of a file. `format` is `None` in the result if no line looks like VIGOR's and
/// the name says nothing either: the file is something else.
pub(super) fn parse<'a>(file: &str, bytes: &'a [u8]) -> Parsed<'a> {
    let mut parsed = Parsed { format: format_of_name(file), ..Parsed::default() };
    if bytes.starts_with(&[0xFF, 0xFE]) || bytes.starts_with(&[0xFE, 0xFF]) {
        let message = "the file is UTF-16; save it as UTF-8";
        parsed.problems.push(Problem::of_file(file, ProblemKind::NotText, message));
        return parsed;
    }
    let bytes = bytes.strip_prefix(&[0xEF, 0xBB, 0xBF]).unwrap_or(bytes);
    let Some(format) = parsed.format.or_else(|| format_of_content(bytes)) else { return parsed };
    parsed.format = Some(format);

    let mut first_seen: HashMap<(&str, &str), usize> = HashMap::new();
    let mut fields = Vec::with_capacity(LABEL_FIELDS);
    for (line, text) in lines(bytes) {
        parsed.lines = line;
        let problem = |field, kind, message| Problem {
            file: file.to_owned(),
            line: Some(line),
            field,
            kind,
            message,
        };
        let Ok(text) = std::str::from_utf8(text) else {
            let message = format!("{} is not UTF-8 text", quoted(&String::from_utf8_lossy(text)));
            parsed.problems.push(problem(None, ProblemKind::NotText, message));
            continue;
        };
        fields.clear();
        fields.extend(text.split_ascii_whitespace());
        if fields.is_empty() {
            parsed.blank += 1;
            continue;
        }
        if let Err(expected) = check_field_count(format, fields.len()) {
            let n = fields.len();
            let message = format!("{n} field{} where {expected}", if n == 1 { "" } else { "s" });
            parsed.problems.push(problem(None, ProblemKind::FieldCount, message));
            continue;
        }
        let mut bad_numbers = Vec::new();
        let record = record(format, line, &fields, &mut bad_numbers);
        if !bad_numbers.is_empty() {
            parsed.problems.extend(bad_numbers.into_iter().map(|field| {
                let message = format!("{} is not a number of pixels", quoted(fields[field - 1]));
                problem(Some(field as u32), ProblemKind::Number, message)
            }));
            continue;
        }
        match first_seen.entry(key(format, &record)) {
            Entry::Vacant(slot) => {
                slot.insert(parsed.records.len());
                parsed.records.push(record);
            }
            Entry::Occupied(slot) => {
                let first = &parsed.records[*slot.get()];
                let (kind, what) = if same_values(first, &record) {
                    (ProblemKind::Duplicate, "repeats")
                } else {
                    (ProblemKind::Conflict, "has the same panorama and other values than")
                };
                let message = format!("{what} line {}, which counts", first.line);
                parsed.problems.push(problem(None, kind, message));
            }
        }
    }
    parsed
}

fn format_of_name(file: &str) -> Option<Format> {
    let name = file.rsplit(['/', '\\']).next().unwrap_or(file);
    if name.starts_with("satellite_list") {
        Some(Format::List)
    } else if name.starts_with("same_area_balanced") || name.starts_with("pano_label") {
        Some(Format::Labels)
    } else {
        None
    }
}

/// The format that most lines have.
fn format_of_content(bytes: &[u8]) -> Option<Format> {
    let is_satellite =
        |text: &str| text.rsplit('/').next().is_some_and(|name| name.starts_with("satellite_"));
    let mut votes = [(0_usize, Format::Labels), (0, Format::Split), (0, Format::List)];
    for (_, text) in lines(bytes) {
        let Ok(text) = std::str::from_utf8(text) else { continue };
        let mut fields = text.split_ascii_whitespace();
        let (first, second) = (fields.next(), fields.next());
        match (first, second, 2 + fields.count()) {
            (Some(_), Some(second), LABEL_FIELDS) if is_satellite(second) => votes[0].0 += 1,
            (Some(first), Some(_), 3 | 5) if is_satellite(first) => votes[1].0 += 1,
            (Some(first), None, _) if is_satellite(first) => votes[2].0 += 1,
            _ => {}
        }
    }
    // `max_by_key` would take the last of equals; ties do not occur in sane files.
    votes.into_iter().filter(|(n, _)| *n > 0).max_by_key(|(n, _)| *n).map(|(_, format)| format)
}

/// What was expected, if a line of `n` fields is not of the format.
fn check_field_count(format: Format, n: usize) -> Result<(), &'static str> {
    match (format, n) {
        (Format::Labels, LABEL_FIELDS) | (Format::Split, 3 | 5) | (Format::List, 1) => Ok(()),
        (Format::Labels, _) => Err("a label line has 13: panorama, then 4 times satellite d0 d1"),
        (Format::Split, _) => Err("a split line has 3 or 5: satellite panorama sky_mask [h w]"),
        (Format::List, _) => Err("a list has 1 per line: the name of a satellite image"),
    }
}

/// Makes a record of the right number of fields; fields that are no numbers go to `bad`, from 1.
fn record<'a>(format: Format, line: u32, fields: &[&'a str], bad: &mut Vec<usize>) -> Record<'a> {
    let mut number = |index: usize| match fields[index].parse::<f64>() {
        Ok(value) if value.is_finite() => value,
        _ => {
            bad.push(index + 1);
            0.0
        }
    };
    let (panorama, sky_mask, pairs) = match format {
        Format::Labels => {
            let pairs = (1..LABEL_FIELDS).step_by(3).map(|i| RawPair {
                satellite: fields[i],
                field: i as u32 + 1,
                offset: Some([number(i + 1), number(i + 2)]),
            });
            (Some((fields[0], 1)), None, pairs.collect())
        }
        Format::Split => {
            // h counts pixels to the south, w to the east; labels count d1 to the west.
            let offset = (fields.len() == 5).then(|| [number(3), -number(4)]);
            let pairs = vec![RawPair { satellite: fields[0], field: 1, offset }];
            (Some((fields[1], 2)), Some(fields[2]), pairs)
        }
        Format::List => {
            (None, None, vec![RawPair { satellite: fields[0], field: 1, offset: None }])
        }
    };
    Record { line, panorama, sky_mask, pairs }
}

/// What may occur only once in a file: a panorama in labels, a pair in splits, a name in lists.
fn key<'a>(format: Format, record: &Record<'a>) -> (&'a str, &'a str) {
    let panorama = record.panorama.map_or("", |(name, _)| name);
    match format {
        Format::Labels => (panorama, ""),
        Format::Split | Format::List => (panorama, record.pairs[0].satellite),
    }
}

fn same_values(a: &Record<'_>, b: &Record<'_>) -> bool {
    a.sky_mask == b.sky_mask && a.pairs == b.pairs
}

/// Lines with their numbers from 1. A line ends with LF, CRLF or CR; what follows the last end is a
/// line only if there is something.
fn lines(bytes: &[u8]) -> impl Iterator<Item = (u32, &[u8])> {
    let mut rest = bytes;
    let mut number = 0;
    std::iter::from_fn(move || {
        if rest.is_empty() {
            return None;
        }
        number += 1;
        let end = rest.iter().position(|b| matches!(b, b'\n' | b'\r')).unwrap_or(rest.len());
        let (line, tail) = rest.split_at(end);
        let skip = if tail.starts_with(b"\r\n") { 2 } else { usize::from(!tail.is_empty()) };
        rest = &tail[skip..];
        Some((number, line))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const S1: &str = "satellite_47.1_-122.1.png";
    const S2: &str = "satellite_47.2_-122.1.png";

    fn label(panorama: &str, first: &str) -> String {
        format!("{panorama} {S1} {first} 2 {S2} 3 4 {S1} 5 6 {S2} 7 8")
    }

    fn kinds(parsed: &Parsed<'_>) -> Vec<(Option<u32>, Option<u32>, ProblemKind)> {
        parsed.problems.iter().map(|p| (p.line, p.field, p.kind)).collect()
    }

    #[test]
    fn line_ends_of_all_kinds_and_none_at_the_end() {
        let text = b"a\r\nb\nc\r\r\n\nd";
        let all: Vec<_> = lines(text).collect();
        let expected: [(u32, &[u8]); 6] =
            [(1, b"a"), (2, b"b"), (3, b"c"), (4, b""), (5, b""), (6, b"d")];
        assert_eq!(all, expected);
        assert_eq!(lines(b"a\r\n").count(), 1);
        assert_eq!(lines(b"").count(), 0);
    }

    #[test]
    fn labels_with_a_byte_order_mark_mixed_line_ends_and_blank_lines() {
        let text = format!(
            "\u{feff}{}\r\n\n   \r\n{}\n{}",
            label("a,1,2,.jpg", "1.0"),
            label("b,1,2,.jpg", "-1e1"),
            label("c,1,2,.jpg", "156.0")
        );
        let parsed = parse("same_area_balanced_train.txt", text.as_bytes());
        assert_eq!(parsed.problems, []);
        assert_eq!((parsed.lines, parsed.blank, parsed.records.len()), (5, 2, 3));
        let record = &parsed.records[1];
        assert_eq!((record.line, record.panorama), (4, Some(("b,1,2,.jpg", 1))));
        assert_eq!(record.pairs.len(), 4);
        assert_eq!(
            record.pairs[0],
            RawPair { satellite: S1, field: 2, offset: Some([-10.0, 2.0]) }
        );
        assert_eq!(record.pairs[3], RawPair { satellite: S2, field: 11, offset: Some([7.0, 8.0]) });
    }

    #[test]
    fn every_bad_line_is_reported_and_the_good_ones_are_kept() {
        let mut text = String::new();
        text += &format!("{}\n", label("a,1,2,.jpg", "x"));
        text += &format!("{} extra\n", label("b,1,2,.jpg", "1"));
        text += "lonely\n";
        text += &format!("{}\n", label("c,1,2,.jpg", "nan").replace(" 8", " inf"));
        text += &format!("{}\n", label("d,1,2,.jpg", "1"));
        text += &format!("{}\n", label("d,1,2,.jpg", "1.0"));
        text += &format!("{}\n", label("d,1,2,.jpg", "2"));
        let mut bytes = text.into_bytes();
        bytes.extend_from_slice(b"\xff\xfe broken\n");
        let parsed = parse("pano_label_balanced.txt", &bytes);
        assert_eq!(
            kinds(&parsed),
            [
                (Some(1), Some(3), ProblemKind::Number),
                (Some(2), None, ProblemKind::FieldCount),
                (Some(3), None, ProblemKind::FieldCount),
                (Some(4), Some(3), ProblemKind::Number),
                (Some(4), Some(13), ProblemKind::Number),
                (Some(6), None, ProblemKind::Duplicate),
                (Some(7), None, ProblemKind::Conflict),
                (Some(8), None, ProblemKind::NotText),
            ]
        );
        assert_eq!(parsed.records.iter().map(|r| r.line).collect::<Vec<_>>(), [5]);
        assert_eq!(
            parsed.problems[1].message,
            "14 fields where a label line has 13: panorama, then 4 times satellite d0 d1"
        );
    }

    #[test]
    fn splits_of_three_and_five_fields_mix() {
        let text = format!(
            "Seattle/satellite/{S1} Seattle/panorama/a,1,2,.jpg Seattle/pano_sky_mask/a.png 12 -3\n\
             Seattle/satellite/{S1} Seattle/panorama/b,1,2,.jpg Seattle/pano_sky_mask/b.png\n\
             Seattle/satellite/{S1} Seattle/panorama/b,1,2,.jpg x y\n"
        );
        let parsed = parse("test_remove_building.txt", text.as_bytes());
        assert_eq!(parsed.format, Some(Format::Split));
        assert_eq!(kinds(&parsed), [(Some(3), None, ProblemKind::FieldCount)]);
        assert_eq!(parsed.records[0].pairs[0].offset, Some([12.0, 3.0]));
        assert_eq!(parsed.records[1].pairs[0].offset, None);
        assert_eq!(parsed.records[1].sky_mask, Some("Seattle/pano_sky_mask/b.png"));
    }

    #[test]
    fn formats_are_told_by_name_or_else_by_content() {
        let list = format!("{S1}\n{S2}\n{S1}\n");
        let parsed = parse("images.txt", list.as_bytes());
        assert_eq!((parsed.format, parsed.records.len()), (Some(Format::List), 2));
        assert_eq!(kinds(&parsed), [(Some(3), None, ProblemKind::Duplicate)]);
        let other = parse("README.txt", b"This is a text\nof five words or so.\n");
        assert_eq!((other.format, other.problems.len()), (None, 0));
        // The name promises labels: what is not one is a problem, not another kind of file.
        let wrong = parse("x/same_area_balanced_test__corrected.txt", b"This is a text\n");
        assert_eq!(kinds(&wrong), [(Some(1), None, ProblemKind::FieldCount)]);
        let empty = parse("satellite_list.txt", b"");
        assert_eq!((empty.lines, empty.records.len(), empty.problems.len()), (0, 0, 0));
    }

    #[test]
    fn utf_16_is_named() {
        let parsed = parse("same_area_balanced_train.txt", b"\xff\xfea\0b\0");
        assert_eq!(kinds(&parsed), [(None, None, ProblemKind::NotText)]);
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic_and_every_line_is_accounted_for(
            bytes in prop::collection::vec(
                prop_oneof![Just(b' '), Just(b'\n'), Just(b'\r'), Just(b'a'), Just(b'1'), any::<u8>()],
                0..400,
            ),
        ) {
            for name in ["satellite_list.txt", "pano_label.txt", "other.txt"] {
                let parsed = parse(name, &bytes);
                if parsed.format.is_some() && parsed.problems.iter().all(|p| p.line.is_some()) {
                    let bad: std::collections::BTreeSet<_> =
                        parsed.problems.iter().map(|p| p.line).collect();
                    let total = parsed.records.len() + bad.len() + parsed.blank as usize;
                    prop_assert_eq!(total, parsed.lines as usize);
                }
            }
        }

        #[test]
        fn numbers_survive(d0 in -1e6..1e6_f64, d1 in -1e6..1e6_f64) {
            let text = format!("p,1,2,.jpg {S1} {d0} {d1} {S2} 0 0 {S2} 0 0 {S2} 0 0");
            let parsed = parse("pano_label.txt", text.as_bytes());
            prop_assert_eq!(parsed.records[0].pairs[0].offset, Some([d0, d1]));
        }
    }
}
