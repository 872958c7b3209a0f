//! The data set in memory: images and panoramas by number, and one record per pair of them.

use super::city::{KnownCity, canonical_name};
use super::kinds::{ImageSize, ImageStatus, LabelKind, Split};
use super::layout::{Layout, TextFile};
use super::name::SatelliteName;
use super::panorama::PanoramaName;
use super::problem::{Problem, ProblemKind, quoted};
use super::text::{Format, Parsed, Record, parse};
use crate::grid::{ImageGrid, LonLat, MAX_LATITUDE_DEG};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, HashMap};

/// What became of one text file.
#[derive(Clone, Debug, Serialize)]
pub struct FileReport {
    /// Path from the root.
    pub file: String,
    /// The city of its lines, if they are all of one.
    pub city: Option<String>,
    /// What it holds; none for files that are not VIGOR's.
    pub format: Option<Format>,
    /// Which labels, if it has any.
    pub labels: Option<LabelKind>,
    /// Which part of the data.
    pub split: Split,
    /// Lines, blank ones included.
    pub lines: u32,
    /// Blank lines.
    pub blank: u32,
    /// Lines taken in.
    pub parsed: u32,
    /// Pairs of a panorama and a satellite image in them.
    pub pairs: u32,
    /// Lines of other cities than the one asked for.
    pub other_cities: u32,
    /// Things reported about the file.
    pub problems: u32,
    /// Why it was not read, if it was not.
    pub skipped: Option<String>,
}

/// A satellite image.
#[derive(Clone, Debug)]
pub struct Satellite {
    /// Index of its city.
    pub city: u32,
    /// File name.
    pub name: String,
    /// Its pixel grid.
    pub grid: ImageGrid,
    /// Whether a list names it.
    pub listed: bool,
    /// Whether a label or split line names it.
    pub labelled: bool,
    /// Whether its file is good.
    pub status: ImageStatus,
}

/// A panorama.
#[derive(Clone, Debug)]
pub struct Panorama {
    /// Index of its city.
    pub city: u32,
    /// File name.
    pub name: String,
    /// Where the camera stood.
    pub position: LonLat,
    /// Whether its file is good.
    pub status: ImageStatus,
}

/// A panorama with one of its satellite images, as one line says it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Index of the file.
    pub file: u32,
    /// Line, from 1.
    pub line: u32,
    /// 0 for the positive, 1 to 3 for the semi-positives.
    pub rank: u8,
    /// Index of the panorama.
    pub panorama: u32,
    /// Index of the satellite image.
    pub satellite: u32,
    /// Label `[d0, d1]`: pixels that the panorama lies south and west of the image's centre.
    pub offset: Option<[f64; 2]>,
    /// Index of the sky mask.
    pub sky_mask: Option<u32>,
}

impl Pair {
    /// Whether the satellite image is the positive of its line.
    #[must_use]
    pub const fn is_positive(&self) -> bool {
        self.rank == 0
    }
}

/// Everything that the text files say, names resolved to numbers.
#[derive(Debug, Default)]
pub struct Dataset {
    /// Names of the cities, sorted as found.
    pub cities: Vec<String>,
    /// Satellite images.
    pub satellites: Vec<Satellite>,
    /// Panoramas.
    pub panoramas: Vec<Panorama>,
    /// Paths of sky masks, as written.
    pub sky_masks: Vec<String>,
    /// Pairs, in the order of files and lines.
    pub pairs: Vec<Pair>,
    /// One report per text file.
    pub files: Vec<FileReport>,
    /// Everything wrong, in the order of files and lines.
    pub problems: Vec<Problem>,
    size: ImageSize,
    city_index: BTreeMap<String, u32>,
    /// Per city, by file name.
    satellite_index: Vec<HashMap<String, u32>>,
    panorama_index: Vec<HashMap<String, u32>>,
    sky_mask_index: HashMap<String, u32>,
}

/// What a name stands for: something known, or something to be taken in.
enum Slot<T> {
    Known(u32),
    New(T),
}

/// A name that cannot be used: its field, the kind of problem and the message.
type Refusal = (Option<u32>, ProblemKind, String);

impl Dataset {
    /// Reads every text file of a layout.
    #[must_use]
    pub fn read(layout: &Layout, size: ImageSize) -> Self {
        let contents: Vec<std::io::Result<Vec<u8>>> =
            layout.files.par_iter().map(|file| std::fs::read(&file.path)).collect();
        let parsed: Vec<Parsed<'_>> = layout
            .files
            .par_iter()
            .zip(&contents)
            .map(|(file, content)| match content {
                Ok(bytes) => parse(&file.name, bytes),
                Err(error) => {
                    let message = format!("cannot be read: {error}");
                    let problem = Problem::of_file(&file.name, ProblemKind::Unreadable, message);
                    Parsed { problems: vec![problem], ..Parsed::default() }
                }
            })
            .collect();
        let mut dataset = Self { size, ..Self::default() };
        for name in layout.cities.keys() {
            dataset.city(name);
        }
        for (file, parsed) in layout.files.iter().zip(parsed) {
            dataset.take_file(layout, file, parsed);
        }
        dataset
    }

    fn take_file(&mut self, layout: &Layout, file: &TextFile, parsed: Parsed<'_>) {
        let index = self.files.len() as u32;
        let labels = parsed.format.and_then(|format| LabelKind::of(format, &file.name));
        let mut report = FileReport {
            file: file.name.clone(),
            city: file.city.clone(),
            format: parsed.format,
            labels,
            split: Split::of(&file.name),
            lines: parsed.lines,
            blank: parsed.blank,
            parsed: 0,
            pairs: 0,
            other_cities: 0,
            problems: 0,
            skipped: None,
        };
        let mut problems = parsed.problems;
        // A single city is everybody's.
        let only_city = || match layout.cities.len() {
            1 => layout.cities.keys().next().cloned(),
            _ => None,
        };
        let default_city = file.city.clone().or_else(only_city);
        let needs_city = parsed.format != Some(Format::Split) && !parsed.records.is_empty();
        report.skipped = match (parsed.format, &default_city) {
            (None, _) if problems.is_empty() => {
                Some("no line of it looks like VIGOR's labels, splits or lists")
            }
            (None, _) => Some("it could not be read"),
            (Some(_), None) if needs_city => {
                let message = "the city of its lines cannot be told; give --city, or move the file to splits/<City>/";
                problems.push(Problem::of_file(&file.name, ProblemKind::City, message));
                Some("its city is unknown")
            }
            (Some(_), _) if parsed.lines == 0 => Some("it is empty"),
            (Some(_), _) => None,
        }
        .map(str::to_owned);
        if report.skipped.is_none() {
            for record in &parsed.records {
                match self.take_record(index, record, default_city.as_deref(), layout) {
                    Ok(0) => report.other_cities += 1,
                    Ok(pairs) => {
                        report.parsed += 1;
                        report.pairs += if record.panorama.is_some() { pairs } else { 0 };
                    }
                    Err(refusals) => problems.extend(refusals.into_iter().map(|refusal| {
                        let (field, kind, message) = refusal;
                        let (file, line) = (file.name.clone(), Some(record.line));
                        Problem { file, line, field, kind, message }
                    })),
                }
            }
            problems.sort_by_key(|p| (p.line, p.field));
        }
        report.problems = problems.len() as u32;
        self.problems.extend(problems);
        self.files.push(report);
    }

    /// Takes in one line; the number of its satellite images, or 0 for another city than asked for.
    fn take_record(
        &mut self,
        file: u32,
        record: &Record<'_>,
        default_city: Option<&str>,
        layout: &Layout,
    ) -> Result<u32, Vec<Refusal>> {
        let first = record.pairs[0].satellite;
        let own = city_of_path(first).map(canonical_name);
        let of_panorama =
            record.panorama.and_then(|(name, _)| city_of_path(name)).map(canonical_name);
        if let (Some(a), Some(b), Some((_, field))) = (&own, &of_panorama, record.panorama)
            && a != b
        {
            let message = format!("the panorama is of {b}, the satellite image of {a}");
            return Err(vec![(Some(field), ProblemKind::City, message)]);
        }
        let Some(city) = own.or(of_panorama).or_else(|| default_city.map(str::to_owned)) else {
            let message = format!(
                "{} names no city; expected <City>/satellite/<name>, or give --city",
                quoted(first)
            );
            return Err(vec![(Some(1), ProblemKind::City, message)]);
        };
        if layout.only.as_ref().is_some_and(|only| *only != city) {
            return Ok(0);
        }
        let city = self.city(&city);

        // All names first: a line with a bad one leaves nothing behind.
        let mut refusals = Vec::new();
        let mut satellites = Vec::with_capacity(record.pairs.len());
        for pair in &record.pairs {
            match self.find_satellite(city, pair.satellite) {
                Ok(slot) => satellites.push(slot),
                Err((kind, message)) => refusals.push((Some(pair.field), kind, message)),
            }
        }
        let panorama = record.panorama.and_then(|(name, field)| {
            self.find_panorama(city, name)
                .map_err(|(kind, message)| refusals.push((Some(field), kind, message)))
                .ok()
        });
        if !refusals.is_empty() {
            return Err(refusals);
        }
        let panorama = panorama.map(|slot| self.add_panorama(slot));
        let sky_mask = record.sky_mask.map(|name| self.sky_mask(name));
        for (rank, (pair, slot)) in record.pairs.iter().zip(satellites).enumerate() {
            let satellite = self.add_satellite(slot);
            let image = &mut self.satellites[satellite as usize];
            let Some(panorama) = panorama else {
                image.listed = true;
                continue;
            };
            image.labelled = true;
            self.pairs.push(Pair {
                file,
                line: record.line,
                rank: rank as u8,
                panorama,
                satellite,
                offset: pair.offset,
                sky_mask,
            });
        }
        Ok(record.pairs.len() as u32)
    }

    fn city(&mut self, name: &str) -> u32 {
        if let Some(index) = self.city_index.get(name) {
            return *index;
        }
        let index = self.cities.len() as u32;
        self.cities.push(name.to_owned());
        self.city_index.insert(name.to_owned(), index);
        self.satellite_index.push(HashMap::new());
        self.panorama_index.push(HashMap::new());
        index
    }

    /// The number of a satellite image by its name, with or without folders.
    pub(super) fn satellite(
        &mut self,
        city: u32,
        path: &str,
    ) -> Result<u32, (ProblemKind, String)> {
        let slot = self.find_satellite(city, path)?;
        Ok(self.add_satellite(slot))
    }

    fn find_satellite(
        &self,
        city: u32,
        path: &str,
    ) -> Result<Slot<Satellite>, (ProblemKind, String)> {
        let name = file_name(path);
        if let Some(index) = self.satellite_index[city as usize].get(name) {
            return Ok(Slot::Known(*index));
        }
        let parsed =
            SatelliteName::parse(name).map_err(|error| (ProblemKind::Name, error.to_string()))?;
        let ImageSize { zoom, pixels } = self.size;
        let grid = ImageGrid::new(parsed.center(), zoom, pixels, pixels)
            .map_err(|error| (ProblemKind::Position, format!("{}: {error}", quoted(name))))?;
        Ok(Slot::New(Satellite {
            city,
            name: name.to_owned(),
            grid,
            listed: false,
            labelled: false,
            status: ImageStatus::Unchecked,
        }))
    }

    fn add_satellite(&mut self, slot: Slot<Satellite>) -> u32 {
        let new = match slot {
            Slot::Known(index) => return index,
            Slot::New(new) => new,
        };
        // A line may name a new image twice.
        let index = self.satellites.len() as u32;
        match self.satellite_index[new.city as usize].entry(new.name.clone()) {
            Entry::Occupied(known) => *known.get(),
            Entry::Vacant(free) => {
                free.insert(index);
                self.satellites.push(new);
                index
            }
        }
    }

    fn find_panorama(
        &self,
        city: u32,
        path: &str,
    ) -> Result<Slot<Panorama>, (ProblemKind, String)> {
        let name = file_name(path);
        if let Some(index) = self.panorama_index[city as usize].get(name) {
            return Ok(Slot::Known(*index));
        }
        let position = PanoramaName::parse(name)
            .map_err(|error| (ProblemKind::Name, error.to_string()))?
            .position();
        if position.lat_deg.abs() > MAX_LATITUDE_DEG {
            let message = format!(
                "{}: latitude {} is outside Web Mercator, which ends at +-{MAX_LATITUDE_DEG:.4} degrees",
                quoted(name),
                position.lat_deg
            );
            return Err((ProblemKind::Position, message));
        }
        let (name, status) = (name.to_owned(), ImageStatus::Unchecked);
        Ok(Slot::New(Panorama { city, name, position, status }))
    }

    fn add_panorama(&mut self, slot: Slot<Panorama>) -> u32 {
        match slot {
            Slot::Known(index) => index,
            Slot::New(new) => {
                let index = self.panoramas.len() as u32;
                self.panorama_index[new.city as usize].insert(new.name.clone(), index);
                self.panoramas.push(new);
                index
            }
        }
    }

    fn sky_mask(&mut self, name: &str) -> u32 {
        if let Some(index) = self.sky_mask_index.get(name) {
            return *index;
        }
        let index = self.sky_masks.len() as u32;
        self.sky_masks.push(name.to_owned());
        self.sky_mask_index.insert(name.to_owned(), index);
        index
    }

    /// The size of the satellite images.
    #[must_use]
    pub const fn size(&self) -> ImageSize {
        self.size
    }

    /// Ground size of a pixel that the corrected labels of a city assume, metres.
    #[must_use]
    pub fn resolution_m(&self, city: u32) -> Option<f64> {
        KnownCity::find(&self.cities[city as usize]).map(|known| known.resolution_m)
    }
}

/// The last part of a path with `/` or `\`.
fn file_name(path: &str) -> &str {
    path.rsplit(['/', '\\']).next().unwrap_or(path)
}

/// `Seattle` of `Seattle/satellite/x.png`, wherever the path starts.
fn city_of_path(path: &str) -> Option<&str> {
    let parts: Vec<&str> = path.split(['/', '\\']).filter(|p| !p.is_empty() && *p != ".").collect();
    let folder = parts.iter().rposition(|part| *part == "satellite" || *part == "panorama");
    match (folder, parts.len()) {
        (Some(0), _) | (None, 0 | 1) => None,
        (Some(i), _) => Some(parts[i - 1]),
        (None, _) => Some(parts[0]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const SAT: &str = "satellite_47.6_-122.3.png";
    const LINE: &str = "a,47.6,-122.3,.jpg satellite_47.6_-122.3.png 1 2 satellite_47.61_-122.3.png 3 4 satellite_47.6_-122.31.png 5 6 satellite_47.61_-122.31.png 7 8";

    fn read(files: &[(&str, &str)], city: Option<&str>) -> Dataset {
        let root = tempfile::tempdir().expect("a folder");
        for (path, text) in files {
            let full = root.path().join(path);
            fs::create_dir_all(full.parent().expect("a parent")).expect("a folder");
            fs::write(full, text).expect("a file");
        }
        let layout = Layout::find(root.path(), city, &[]).expect("a layout");
        Dataset::read(&layout, ImageSize::default())
    }

    fn told(dataset: &Dataset) -> Vec<String> {
        dataset.problems.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn names_become_numbers_once() {
        let list = format!("{SAT}\nsatellite_1_1.png\n");
        let dataset = read(
            &[
                ("Seattle/satellite_list.txt", list.as_str()),
                ("Seattle/same_area_balanced_train__corrected.txt", LINE),
                ("Seattle/same_area_balanced_test.txt", LINE),
            ],
            None,
        );
        assert_eq!(told(&dataset), Vec::<String>::new());
        assert_eq!(dataset.cities, ["Seattle"]);
        assert_eq!((dataset.satellites.len(), dataset.panoramas.len()), (5, 1));
        assert_eq!(dataset.pairs.len(), 8);
        assert_eq!(dataset.pairs.iter().filter(|p| p.is_positive()).count(), 2);
        let image = dataset.satellites.iter().find(|s| s.name == SAT).expect("the image");
        assert!(image.listed && image.labelled);
        let kinds: Vec<_> = dataset.files.iter().map(|f| (f.labels, f.split)).collect();
        assert_eq!(
            kinds,
            [
                (Some(LabelKind::Original), Split::Test),
                (Some(LabelKind::Corrected), Split::Train),
                (None, Split::All)
            ]
        );
    }

    #[test]
    fn one_bad_name_drops_its_line_and_is_reported_with_its_field() {
        let bad = LINE.replace("a,47.6,", "a,97.6,").replace("satellite_47.61_-122.31", "sat_x");
        let far = LINE.replace("satellite_47.61_-122.3.", "satellite_85.06_-122.3.");
        let text = format!("{bad}\n{}\n{LINE}\n", far.replace("a,", "b,"));
        let dataset = read(&[("Seattle/same_area_balanced_train.txt", text.as_str())], None);
        let told = told(&dataset);
        assert_eq!(told.len(), 3, "{told:?}");
        let file = "Seattle/same_area_balanced_train.txt";
        assert!(told[0].starts_with(&format!("{file}:1, field 1: `a,97.6,-122.3,.jpg`: lat")));
        assert!(told[1].starts_with(&format!("{file}:1, field 11: `sat_x.png` is not named")));
        assert!(told[2].starts_with(&format!("{file}:2, field 5: ")), "{}", told[2]);
        assert_eq!((dataset.files[0].parsed, dataset.files[0].pairs), (1, 4));
        assert_eq!((dataset.panoramas.len(), dataset.satellites.len()), (1, 4));
    }

    #[test]
    fn split_lines_carry_their_city_and_disagreement_is_a_problem() {
        let text = format!(
            "NewYork/satellite/{SAT} NewYork/panorama/a,1,2,.jpg NewYork/pano_sky_mask/a.png\n\
             NewYork/satellite/{SAT} Seattle/panorama/b,1,2,.jpg m.png 1 2\n\
             {SAT} c,1,2,.jpg m.png 1 2\n"
        );
        let files = [
            ("train_x.txt", text.as_str()),
            ("Seattle/a.txt", ""),
            ("Chicago/satellite_list.txt", ""),
        ];
        let dataset = read(&files, None);
        assert_eq!(
            told(&dataset),
            [
                "train_x.txt:2, field 2: the panorama is of Seattle, the satellite image of NewYork"
                    .to_owned(),
                // One city folder is everybody's, so this line is Chicago's: no problem.
            ]
        );
        assert_eq!(dataset.cities, ["Chicago", "NewYork"]);
        assert_eq!(dataset.pairs.len(), 2);
        assert_eq!(dataset.sky_masks, ["NewYork/pano_sky_mask/a.png", "m.png"]);
        let one = read(&files, Some("chicago"));
        assert_eq!(one.files.iter().map(|f| f.other_cities).sum::<u32>(), 1);
        assert_eq!(one.pairs.len(), 1);
    }

    #[test]
    fn labels_of_no_city_are_refused_as_a_file() {
        let files = [
            ("same_area_balanced_train.txt", LINE),
            ("Chicago/satellite_list.txt", ""),
            ("Seattle/satellite_list.txt", ""),
        ];
        let dataset = read(&files, None);
        assert_eq!(told(&dataset).len(), 1);
        assert!(told(&dataset)[0].contains("--city"));
        assert!(dataset.pairs.is_empty());
    }

    #[test]
    fn cities_of_paths() {
        for (path, city) in [
            ("Seattle/satellite/x.png", Some("Seattle")),
            ("/data/VIGOR/Seattle/panorama/x.jpg", Some("Seattle")),
            (r".\Seattle\satellite\x.png", Some("Seattle")),
            ("Seattle/x.png", Some("Seattle")),
            ("satellite/x.png", None),
            ("x.png", None),
        ] {
            assert_eq!(city_of_path(path), city, "{path}");
        }
    }
}
