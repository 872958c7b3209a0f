//! Kinds of labels, splits and image states, and the size of the images.

use super::text::Format;
use serde::Serialize;

/// The size of the satellite images.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct ImageSize {
    /// Web-Mercator zoom; the world is `256 * 2^zoom` pixels around.
    pub zoom: u8,
    /// Width and height in pixels.
    pub pixels: u32,
}

impl Default for ImageSize {
    /// VIGOR's: zoom 20, 640 x 640.
    fn default() -> Self {
        Self { zoom: 20, pixels: 640 }
    }
}

/// Which labels a file holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum LabelKind {
    /// VIGOR's own, which assume 0.114 m per pixel everywhere.
    Original,
    /// SliceMatch's corrected labels.
    Corrected,
    /// Sat3DGen's split files.
    Sat3dgen,
}

impl LabelKind {
    /// Every kind, in the order of their numbers.
    pub const ALL: [Self; 3] = [Self::Original, Self::Corrected, Self::Sat3dgen];

    /// `original`, `corrected` or `sat3dgen`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Original => "original",
            Self::Corrected => "corrected",
            Self::Sat3dgen => "sat3dgen",
        }
    }

    /// By format, and by `corrected` in the path of a label file.
    pub(super) fn of(format: Format, file: &str) -> Option<Self> {
        match format {
            Format::List => None,
            Format::Split => Some(Self::Sat3dgen),
            Format::Labels if file.contains("corrected") => Some(Self::Corrected),
            Format::Labels => Some(Self::Original),
        }
    }
}

/// Which part of the data a file says it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// For training.
    Train,
    /// For validation.
    Val,
    /// For testing.
    Test,
    /// Not divided.
    All,
}

impl Split {
    /// Every split, in the order of their numbers.
    pub const EACH: [Self; 4] = [Self::Train, Self::Val, Self::Test, Self::All];

    /// `train`, `val`, `test` or `all`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Val => "val",
            Self::Test => "test",
            Self::All => "all",
        }
    }

    /// By a word of the file's name.
    pub(super) fn of(file: &str) -> Self {
        let name = file.rsplit('/').next().unwrap_or(file).to_ascii_lowercase();
        let has = |word| name.split(|c: char| !c.is_ascii_alphabetic()).any(|w| w == word);
        match () {
            () if has("train") => Self::Train,
            () if has("val") => Self::Val,
            () if has("test") => Self::Test,
            () => Self::All,
        }
    }
}

/// Whether an image file is there and good.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ImageStatus {
    /// There is no image folder to look in.
    #[default]
    Unchecked,
    /// The file exists; nobody looked inside.
    Found,
    /// The file exists and passed the check.
    Good,
    /// The file does not exist.
    Missing,
    /// The file exists and failed the check.
    Bad,
}

impl ImageStatus {
    /// Every status, in the order of their numbers.
    pub const ALL: [Self; 5] = [Self::Unchecked, Self::Found, Self::Good, Self::Missing, Self::Bad];

    /// `unchecked`, `found`, `ok`, `missing` or `bad`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unchecked => "unchecked",
            Self::Found => "found",
            Self::Good => "ok",
            Self::Missing => "missing",
            Self::Bad => "bad",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splits_by_whole_words() {
        assert_eq!(Split::of("a/train__corrected_all_3city_remove_building.txt"), Split::Train);
        assert_eq!(Split::of("same_area_balanced_test__corrected.txt"), Split::Test);
        assert_eq!(Split::of("val__corrected.txt"), Split::Val);
        assert_eq!(Split::of("latest_labels.txt"), Split::All);
    }

    #[test]
    fn numbers_are_places_in_the_lists_of_names() {
        for (i, kind) in LabelKind::ALL.into_iter().enumerate() {
            assert_eq!(kind as usize, i);
        }
        for (i, split) in Split::EACH.into_iter().enumerate() {
            assert_eq!(split as usize, i);
        }
        for (i, status) in ImageStatus::ALL.into_iter().enumerate() {
            assert_eq!(status as usize, i);
        }
    }
}
