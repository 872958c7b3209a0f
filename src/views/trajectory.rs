//! Paths through the image, as the reference's drawing tool writes them.
//!
//! A CSV with the columns `w` and `h`: column and row in pixels of the image as it was given; `angle`, if it is
//! there, is the direction of travel in radians from east, clockwise.

use serde::Serialize;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// What a path's frames show.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameKind {
    /// A panorama; its middle looks north.
    Panorama,
    /// A perspective picture that looks along the path.
    Follow,
    /// Four perspective pictures side by side: left, front, right, back.
    Surround {
        /// Front is along the path; otherwise it is north.
        follow: bool,
        /// The picture to the back is mirrored, as the reference shows it.
        mirrored: bool,
    },
}

impl FrameKind {
    /// Whether the direction of travel matters.
    #[must_use]
    pub fn follows(self) -> bool {
        matches!(self, Self::Follow | Self::Surround { follow: true, .. })
    }
}

/// A place on a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Station {
    /// Column and row of the image as it was given.
    pub pixel: [f64; 2],
    /// Direction of travel: 0 north, 90 east; `None` where the path has none.
    pub yaw_deg: Option<f64>,
}

/// A path. Only its name, digest and number of rows go into a plan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Trajectory {
    /// Name of the file, without folders.
    pub name: String,
    /// SHA-256 of the file.
    pub sha256: String,
    /// Rows of the file.
    pub count: usize,
    /// The rows.
    #[serde(skip)]
    pub stations: Vec<Station>,
}

/// Why a path cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrajectoryError {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A column is missing.
    #[error(
        "{}: no column `{column}`; a path has the columns w and h (pixels of the image), and may have angle",
        path.display()
    )]
    Column {
        /// The file.
        path: PathBuf,
        /// The column.
        column: &'static str,
    },
    /// The file is no CSV.
    #[error("{}: {source}", path.display())]
    Csv {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: csv::Error,
    },
    /// A field that is no finite number.
    #[error("{}: line {line}: `{column}` is `{value}`, not a number", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// Its line, from 1.
        line: u64,
        /// The column.
        column: &'static str,
        /// What stands there.
        value: String,
    },
    /// No rows.
    #[error("{}: no rows", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// A path without a direction, where one is needed.
    #[error(
        "{}: all rows are the same place, so there is no way to look along; give a column `angle`",
        path.display()
    )]
    NoDirection {
        /// The file.
        path: PathBuf,
    },
}

impl Trajectory {
    /// Reads a path. The direction of travel is the column `angle` (yaw = angle in degrees + 90); where there
    /// is none, the direction from the row before to the row after.
    ///
    /// # Errors
    /// [`TrajectoryError`] with line, column and value; [`TrajectoryError::NoDirection`] only if `follows`.
    pub fn read(path: &Path, follows: bool) -> Result<Self, TrajectoryError> {
        let path_of = || path.to_owned();
        let bytes = std::fs::read(path)
            .map_err(|source| TrajectoryError::Io { path: path_of(), source })?;
        // Spreadsheets begin files with a mark of their encoding.
        let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(text);
        let fail = |source| TrajectoryError::Csv { path: path_of(), source };
        let header = reader.headers().map_err(fail)?.clone();
        let column = |name| header.iter().position(|column| column.eq_ignore_ascii_case(name));
        let needed =
            |name| column(name).ok_or(TrajectoryError::Column { path: path_of(), column: name });
        let (w, h, angle) = (needed("w")?, needed("h")?, column("angle"));
        let mut stations = Vec::new();
        for record in reader.records() {
            let record = record.map_err(fail)?;
            let number = |index: usize, column: &'static str| {
                let text = record.get(index).unwrap_or_default();
                text.parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(|| {
                    let line = record.position().map_or(0, csv::Position::line);
                    let value = text.to_owned();
                    TrajectoryError::Field { path: path_of(), line, column, value }
                })
            };
            let yaw_deg = match angle {
                Some(angle) => Some(yaw_of_angle(number(angle, "angle")?)),
                None => None,
            };
            stations.push(Station { pixel: [number(w, "w")?, number(h, "h")?], yaw_deg });
        }
        if stations.is_empty() {
            return Err(TrajectoryError::Empty { path: path_of() });
        }
        if angle.is_none() {
            tangents(&mut stations);
        }
        if follows && stations.iter().any(|station| station.yaw_deg.is_none()) {
            return Err(TrajectoryError::NoDirection { path: path_of() });
        }
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let sha256 = crate::plan::hex(&Sha256::digest(&bytes));
        Ok(Self { name, sha256, count: stations.len(), stations })
    }
}

/// Radians from east, clockwise, to degrees from north, clockwise.
fn yaw_of_angle(angle: f64) -> f64 {
    angle.to_degrees() + 90.0
}

/// Directions of a path from its places: from the last other place before a row (or the row itself) to the
/// first other place after it.
fn tangents(stations: &mut [Station]) {
    let pixels: Vec<[f64; 2]> = stations.iter().map(|station| station.pixel).collect();
    for (index, station) in stations.iter_mut().enumerate() {
        let here = pixels[index];
        let other = |pixel: &&[f64; 2]| **pixel != here;
        let before = pixels[..index].iter().rev().find(other).copied();
        let after = pixels[index + 1..].iter().find(other).copied();
        let ends = match (before, after) {
            // There and back: the way ahead counts.
            (Some(before), Some(after)) if before == after => Some((here, after)),
            (Some(before), Some(after)) => Some((before, after)),
            (None, Some(after)) => Some((here, after)),
            (Some(before), None) => Some((before, here)),
            (None, None) => None,
        };
        station.yaw_deg = ends.map(|(a, b)| yaw_of_angle(libm::atan2(b[1] - a[1], b[0] - a[0])));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str, follows: bool) -> Result<Trajectory, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("path.csv");
        std::fs::write(&path, text).expect("writes");
        Trajectory::read(&path, follows).map_err(|error| error.to_string())
    }

    fn yaws(text: &str) -> Vec<f64> {
        read(text, true).expect(text).stations.iter().filter_map(|s| s.yaw_deg).collect()
    }

    #[test]
    fn angles_turn_clockwise_from_east() {
        // East, south, west, north.
        let text = "w,h,angle\n1,2,0\n1,2,1.5707963267948966\n1,2,3.141592653589793\n1,2,-1.5707963267948966\n";
        assert_eq!(yaws(text), [90.0, 180.0, 270.0, 0.0]);
    }

    #[test]
    fn without_angles_the_path_says_where_it_goes() {
        // East, then a corner to the south, then south, with a stop; w and h in the other order.
        let text = "h,w\n5,0\n5,10\n15,10\n15,10\n25,10\n";
        assert_eq!(yaws(text), [90.0, 135.0, 180.0, 180.0, 180.0]);
        assert_eq!(yaws("w,h\n0,5\n0,0\n0,5\n"), [0.0, 180.0, 180.0]);
    }

    #[test]
    fn errors_name_line_column_and_value() {
        assert!(read("w,angle\n1,2\n", false).is_err_and(|e| e.contains("no column `h`")));
        let error = read("w,h\n1,2\n1,x\n", false).expect_err("no number");
        assert!(error.contains("line 3") && error.contains("`h` is `x`"), "{error}");
        assert!(read("w,h\n", false).is_err_and(|e| e.contains("no rows")));
        assert!(read("w,h\n1,1\n1,1\n", true).is_err_and(|e| e.contains("column `angle`")));
        assert!(read("w,h\n1,1\n", false).is_ok());
        assert!(read("w,h\n1,2\n1\n", false).is_err());
        assert!(read("w,h\nnan,2\n", false).is_err_and(|e| e.contains("`nan`")));
    }
}
