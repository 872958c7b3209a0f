//! The summary of an ingest: `summary.json`, and what is printed.

use super::dataset::{Dataset, FileReport};
use super::ingest::{CityImages, IngestOptions};
use super::measure::Measured;
use super::problem::{Problem, ProblemKind};
use super::statistics::{
    Distribution, LabelStatistics, OverlapStatistics, RoleStatistics, of_labels, of_overlap,
};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;

/// Problems and bad images that are printed; all are in `summary.json`.
const PRINTED: usize = 20;

/// An image that failed its check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct BadImage {
    /// File name.
    pub file: String,
    /// What is wrong with it.
    pub problem: String,
}

/// What was found in a folder of images.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ImageCounts {
    /// Files in the folder.
    pub in_folder: u64,
    /// Images that are there and passed the check asked for.
    pub good: u64,
    /// Images that lists or labels name and the folder lacks.
    pub missing: u64,
    /// Images that failed the check.
    pub bad: u64,
    /// Images in the folder that no list or label names.
    pub not_in_lists: u64,
    /// Files in the folder that are not named like images.
    pub other_files: u64,
    /// Names of the missing.
    pub missing_files: Vec<String>,
    /// Names of the bad, with the reason.
    pub bad_files: Vec<BadImage>,
}

/// One city.
#[derive(Clone, Debug, Serialize)]
pub struct CitySummary {
    /// Name.
    pub city: String,
    /// Panoramas that labels or splits name.
    pub panoramas: u64,
    /// Satellite images known: listed, labelled or in the folder.
    pub satellites: u64,
    /// Satellite images that a list names.
    pub satellites_listed: u64,
    /// Satellite images that labels or splits name.
    pub satellites_labelled: u64,
    /// Per kind of labels.
    pub labels: Vec<LabelStatistics>,
    /// How the satellite images overlap.
    pub overlap: Option<OverlapStatistics>,
    /// The satellite folder, if there is one.
    pub satellite_images: Option<ImageCounts>,
    /// The panorama folder, if there is one.
    pub panorama_images: Option<ImageCounts>,
}

/// What `summary.json` holds.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// The program and its version.
    pub program: String,
    /// The settings that decide the content.
    pub options: IngestOptions,
    /// Rows of the manifest.
    pub pairs: u64,
    /// One report per text file.
    pub files: Vec<FileReport>,
    /// Per city.
    pub cities: Vec<CitySummary>,
    /// Problems by kind.
    pub problem_counts: BTreeMap<ProblemKind, u64>,
    /// Every problem.
    pub problems: Vec<Problem>,
}

impl Summary {
    pub(super) fn new(
        dataset: &Dataset,
        measured: &[Measured],
        options: &IngestOptions,
        mut images: CityImages,
    ) -> Self {
        let mut cities: Vec<CitySummary> = (0..dataset.cities.len() as u32)
            .map(|city| {
                let of_city = |count: &dyn Fn(&super::dataset::Satellite) -> bool| {
                    dataset.satellites.iter().filter(|s| s.city == city && count(s)).count() as u64
                };
                let resolution = options.resolution_m.or_else(|| dataset.resolution_m(city));
                let [satellite_images, panorama_images] = images.remove(&city).unwrap_or_default();
                CitySummary {
                    city: dataset.cities[city as usize].clone(),
                    panoramas: dataset.panoramas.iter().filter(|p| p.city == city).count() as u64,
                    satellites: of_city(&|_| true),
                    satellites_listed: of_city(&|s| s.listed),
                    satellites_labelled: of_city(&|s| s.labelled),
                    labels: of_labels(dataset, measured, city, resolution),
                    overlap: of_overlap(dataset, city),
                    satellite_images,
                    panorama_images,
                }
            })
            .collect();
        cities.sort_by(|a, b| a.city.cmp(&b.city));
        let mut problem_counts = BTreeMap::new();
        for problem in &dataset.problems {
            *problem_counts.entry(problem.kind).or_default() += 1;
        }
        Self {
            program: concat!("sat3d ", env!("CARGO_PKG_VERSION")).to_owned(),
            options: options.clone(),
            pairs: dataset.pairs.len() as u64,
            files: dataset.files.clone(),
            cities,
            problem_counts,
            problems: dataset.problems.clone(),
        }
    }

    /// The summary as JSON, indented, ending with a line end.
    #[must_use]
    pub fn to_json(&self) -> String {
        // Only numbers that are no numbers could fail, and JSON writes those as null.
        let mut text = serde_json::to_string_pretty(self).unwrap_or_default();
        text.push('\n');
        text
    }
}

impl fmt::Display for Summary {
    /// What a person wants to know: what was done, what was left out and why.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for city in &self.cities {
            city.fmt(f)?;
        }
        let skipped: Vec<&FileReport> = self.files.iter().filter(|f| f.skipped.is_some()).collect();
        for file in &skipped {
            let reason = file.skipped.as_deref().unwrap_or_default();
            writeln!(f, "skipped {}: {reason}", file.file)?;
        }
        let lines: u64 = self.files.iter().map(|f| u64::from(f.lines)).sum();
        writeln!(
            f,
            "{} lines of {} text files: {} pairs, {}",
            lines,
            self.files.len() - skipped.len(),
            self.pairs,
            plural(self.problems.len() as u64, "problem"),
        )?;
        list(f, &self.problems)
    }
}

impl fmt::Display for CitySummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{}: {}, {}",
            self.city,
            plural(self.panoramas, "panorama"),
            plural(self.satellites, "satellite image")
        )?;
        for labels in &self.labels {
            write_labels(f, labels)?;
        }
        if let Some(overlap) = &self.overlap {
            let at_least = |k: usize| overlap.share_at_least.get(k - 1).copied().unwrap_or(0.0);
            writeln!(
                f,
                "  overlap     {:.2} images show a point of the ground on average ({:.1} % of {:.2} km2 twice or more, {:.1} % four times or more)",
                overlap.mean_images,
                100.0 * at_least(2),
                overlap.union_km2,
                100.0 * at_least(4),
            )?;
        }
        for (what, images) in
            [("satellite", &self.satellite_images), ("panorama", &self.panorama_images)]
        {
            let Some(images) = images else {
                writeln!(f, "  {what:11} no {what}/ folder: images not checked")?;
                continue;
            };
            writeln!(
                f,
                "  {what:11} {} good, {} missing, {} bad, {} in no list, {} other files",
                images.good, images.missing, images.bad, images.not_in_lists, images.other_files
            )?;
            for bad in images.bad_files.iter().take(PRINTED) {
                writeln!(f, "    {} {}", bad.file, bad.problem)?;
            }
            more(f, images.bad_files.len())?;
        }
        Ok(())
    }
}

fn write_labels(f: &mut fmt::Formatter<'_>, labels: &LabelStatistics) -> fmt::Result {
    write!(f, "  {:11} {}", labels.labels.name(), plural(labels.pairs, "pair"))?;
    match labels.resolution_m {
        Some(resolution) if labels.reproduced + labels.not_reproduced > 0 => writeln!(
            f,
            "; the UTM formula at {resolution} m/px gives {} of {} labels{}",
            labels.reproduced,
            labels.reproduced + labels.not_reproduced,
            match labels.fitted_resolution_m {
                Some(fitted) if labels.not_reproduced > 0 =>
                    format!("; {fitted:.6} m/px fits them best"),
                _ => String::new(),
            }
        )?,
        None if labels.without_label < labels.pairs => writeln!(
            f,
            "; UTM formula not checked: the city's resolution is unknown (give --resolution)"
        )?,
        _ => writeln!(f, ", without labels")?,
    }
    for (name, role) in [("positive", &labels.positive), ("semi-positive", &labels.semi_positive)] {
        if role.pairs > 0 {
            write_role(f, name, role)?;
        }
    }
    let lines = labels.positive.pairs;
    let share = |n: u64| 100.0 * n as f64 / lines.max(1) as f64;
    writeln!(
        f,
        "    nearest        the positive is the nearest of its line in {:.2} %, of the city in {:.2} %",
        share(labels.positive_nearest_of_line),
        share(labels.positive_nearest_of_city),
    )?;
    if let Some(t) = &labels.train_test {
        let ground = t.test_ground_in_training.map_or_else(String::new, |share| {
            format!(
                "; training shows {:.1} % of the ground under the test's positives",
                100.0 * share
            )
        });
        writeln!(
            f,
            "    train/test     share {} of {} + {} panoramas, {} of {} + {} satellite images{ground}",
            t.shared_panoramas,
            t.train_panoramas,
            t.test_panoramas,
            t.shared_satellites,
            t.train_satellites,
            t.test_satellites,
        )?;
    }
    Ok(())
}

fn write_role(f: &mut fmt::Formatter<'_>, name: &str, role: &RoleStatistics) -> fmt::Result {
    write!(f, "    {name:14} ")?;
    if let (Some(px), Some(m)) = (&role.residual_px, &role.residual_m) {
        let three = |d: &Distribution| format!("{:.2} / {:.2} / {:.2}", d.mean, d.p95, d.max);
        write!(
            f,
            "label against exact pixel, mean / p95 / max: {} px, {} m; ",
            three(px),
            three(m)
        )?;
    }
    let share = 100.0 * role.outside as f64 / role.pairs as f64;
    write!(f, "{} of {} outside the image ({share:.1} %", role.outside, role.pairs)?;
    if role.label_outside != role.outside {
        write!(f, "; {} by their labels", role.label_outside)?;
    }
    writeln!(f, ")")
}

fn plural(n: u64, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}

fn list(f: &mut fmt::Formatter<'_>, problems: &[Problem]) -> fmt::Result {
    for problem in problems.iter().take(PRINTED) {
        writeln!(f, "  {problem}")?;
    }
    more(f, problems.len())
}

fn more(f: &mut fmt::Formatter<'_>, n: usize) -> fmt::Result {
    if n > PRINTED {
        writeln!(f, "  ... and {} more, all in summary.json", n - PRINTED)?;
    }
    Ok(())
}
