//! From a [`CrsSpec`] to the one operation that serves it.

use super::closed::{self, Chosen, ClosedForm};
use super::table::{self, Area, Datum, Entry, Operation, Step};
use super::{CrsError, CrsSpec, ResolveOptions, ResolvedCrs};
use crate::grid::LonLat;
use std::sync::Arc;

/// What `--operation` asks for.
pub(crate) enum Pinned<'a> {
    /// EPSG code of a datum operation.
    Code(u32),
    /// `null` or `ballpark`: datums are taken for equal.
    Ballpark,
    /// A PROJ pipeline from longitude and latitude (degrees) to the CRS.
    Pipeline(&'a str),
}

impl<'a> Pinned<'a> {
    fn parse(text: &'a str) -> Option<Self> {
        let text = text.trim();
        let digits = match text.get(..5) {
            Some(prefix) if prefix.eq_ignore_ascii_case("EPSG:") => &text[5..],
            _ => text,
        };
        if let Ok(code) = digits.parse() {
            return Some(Self::Code(code));
        }
        if text.eq_ignore_ascii_case("null") || text.eq_ignore_ascii_case("ballpark") {
            return Some(Self::Ballpark);
        }
        text.contains("proj=").then_some(Self::Pipeline(text))
    }
}

/// Finds the one operation that leads from WGS 84 to a CRS: the closed form where the table has the
/// code (in every build), PROJ where it is linked for every other CRS and for operations that the
/// closed forms do not have.
///
/// The returned specification carries the table's name and no WKT where the code says it all, so
/// that both builds write the same into manifests.
///
/// # Errors
/// [`CrsError::Geographic`] for axes in degrees, [`CrsError::Unsupported`] for a CRS that this build
/// cannot serve, [`CrsError::Operation`] for an operation that does not lead there.
pub fn resolve(spec: &CrsSpec, options: &ResolveOptions) -> Result<ResolvedCrs, CrsError> {
    if spec.geographic {
        return Err(CrsError::Geographic { name: spec.label() });
    }
    let pinned = match options.operation.as_deref() {
        None => None,
        Some(text) => Some(Pinned::parse(text).ok_or_else(|| {
            CrsError::Operation {
                operation: text.to_owned(),
                name: spec.label(),
                reason: "give an EPSG code of a datum operation (1901), `null`, or a PROJ pipeline"
                    .to_owned(),
            }
        })?),
    };
    match spec.epsg.and_then(table::entry) {
        Some(entry) => match choose(entry, pinned.as_ref(), options) {
            Some(chosen) => closed_form(spec, entry, chosen, pinned.is_some(), options),
            None => elsewhere(spec, pinned.as_ref(), options, || {
                let known = closed_form_operations(entry);
                format!(
                    "the closed forms know {known} for {}; anything else needs a build of sat3d with PROJ (feature `proj`)",
                    entry.base.name
                )
            }),
        },
        None => elsewhere(spec, pinned.as_ref(), options, String::new),
    }
}

/// The datum step of a closed form, or `None` where only PROJ can take it.
fn choose(entry: &Entry, pinned: Option<&Pinned<'_>>, options: &ResolveOptions) -> Option<Chosen> {
    let preferred = match entry.datum {
        Datum::Same => Chosen::Same,
        Datum::Ballpark => Chosen::Ballpark,
        Datum::Operation(code) => Chosen::Operation(table::operation(code)?),
    };
    let chosen = match pinned {
        None => preferred,
        Some(Pinned::Ballpark) if entry.datum == Datum::Same => Chosen::Same,
        Some(Pinned::Ballpark) => Chosen::Ballpark,
        Some(Pinned::Code(code)) => {
            let operation = table::operation(*code)?;
            if operation.source != entry.base.code || matches!(operation.step, Step::Grid(_)) {
                return None;
            }
            Chosen::Operation(operation)
        }
        Some(Pinned::Pipeline(text)) => {
            // A manifest's own definition, given back.
            let words = |text: &str| text.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
            (words(text) == words(&closed::pipeline(entry, preferred))).then_some(preferred)?
        }
    };
    match chosen {
        Chosen::Operation(_) if options.without_datum_step => Some(Chosen::Ballpark),
        _ => Some(chosen),
    }
}

fn closed_form(
    spec: &CrsSpec,
    entry: &Entry,
    chosen: Chosen,
    pinned: bool,
    options: &ResolveOptions,
) -> Result<ResolvedCrs, CrsError> {
    let form = ClosedForm::new(entry, chosen)?;
    let area = options.area.map(Area::new);
    let around = area.unwrap_or(entry.area).samples();
    let operation = closed::operation_info(entry, chosen, &form, &around)?;
    let warnings =
        if options.without_datum_step { Vec::new() } else { warnings(entry, chosen, pinned, area) };
    Ok(ResolvedCrs {
        spec: CrsSpec {
            name: entry.name.to_owned(),
            epsg: Some(entry.code),
            geographic: false,
            linear_unit: Some(entry.unit),
            vertical: spec.vertical.clone(),
            wkt: None,
        },
        metres_per_unit: entry.unit.metres_per_unit(),
        operation,
        projection: Arc::new(form),
        warnings,
    })
}

/// What the user should know about the datum step of a closed form.
fn warnings(entry: &Entry, chosen: Chosen, pinned: bool, area: Option<Area>) -> Vec<String> {
    let mut warnings = Vec::new();
    let crs = format!("EPSG:{} ({})", entry.code, entry.name);
    if let Some(area) = area.filter(|area| !area.intersects(&entry.area)) {
        warnings.push(format!(
            "{crs}: the work ({area}) lies outside the CRS's area of use ({}); is it the right CRS?",
            entry.area
        ));
    }
    let Chosen::Operation(operation) = chosen else {
        if chosen == Chosen::Ballpark {
            warnings.push(format!(
                "{crs}: {} is taken to equal WGS 84; how many metres that is off, nobody states (for NAD83 it is 1 to 2 m)",
                entry.base.name
            ));
        }
        return warnings;
    };
    let place = area.unwrap_or(entry.area);
    if !place.intersects(&operation.area) {
        warnings.push(format!(
            "{crs}: the work lies outside the area of use of EPSG:{} {} ({}), so its stated accuracy of {} m does not hold",
            operation.code, operation.name, operation.area, operation.accuracy_m
        ));
    }
    if operation.step == Step::Null {
        warnings.push(format!(
            "{crs}: its datum is taken to equal WGS 84 (EPSG:{} {}, a null shift): positions are good to {} m at best",
            operation.code, operation.name, operation.accuracy_m
        ));
    }
    // Whoever pinned an operation has chosen.
    if let Some((better, grid)) = better_with_grid(operation, &place).filter(|_| !pinned) {
        warnings.push(format!(
            "{crs}: EPSG:{} {} would be good to {} m instead of {} m, but needs the grid {grid}; with PROJ and that grid installed, use `--operation {}`",
            better.code, better.name, better.accuracy_m, operation.accuracy_m, better.code
        ));
    }
    warnings
}

/// The most accurate grid operation of the same datum for a place, if it beats the given one.
fn better_with_grid(
    operation: &Operation,
    place: &Area,
) -> Option<(&'static Operation, &'static str)> {
    table::OPERATIONS
        .iter()
        .filter_map(|other| match other.step {
            Step::Grid(grid) => Some((other, grid)),
            _ => None,
        })
        .filter(|(other, _)| {
            other.source == operation.source
                && other.area.contains(place.centre())
                && other.accuracy_m < operation.accuracy_m
        })
        .min_by(|(a, _), (b, _)| a.accuracy_m.total_cmp(&b.accuracy_m).then(a.code.cmp(&b.code)))
}

fn closed_form_operations(entry: &Entry) -> String {
    let codes: Vec<_> = table::OPERATIONS
        .iter()
        .filter(|o| o.source == entry.base.code && !matches!(o.step, Step::Grid(_)))
        .map(|o| format!("{} ({}, {} m)", o.code, o.name, o.accuracy_m))
        .collect();
    if codes.is_empty() { "no datum operation but `null`".to_owned() } else { codes.join(", ") }
}

#[cfg(feature = "proj")]
fn elsewhere(
    spec: &CrsSpec,
    pinned: Option<&Pinned<'_>>,
    options: &ResolveOptions,
    _closed_forms: impl Fn() -> String,
) -> Result<ResolvedCrs, CrsError> {
    super::authority::resolve(spec, pinned, options)
}

/// Refuses by name what only PROJ can serve.
#[cfg(not(feature = "proj"))]
fn elsewhere(
    spec: &CrsSpec,
    pinned: Option<&Pinned<'_>>,
    options: &ResolveOptions,
    closed_forms: impl Fn() -> String,
) -> Result<ResolvedCrs, CrsError> {
    let name = spec.label();
    match (pinned, spec.epsg.and_then(table::entry)) {
        (Some(_), Some(_)) => Err(CrsError::Operation {
            operation: options.operation.clone().unwrap_or_default(),
            name,
            reason: closed_forms(),
        }),
        _ => Err(CrsError::Unsupported {
            name,
            reason: "this build of sat3d has no PROJ and knows the US State Plane zones and UTM zones only; use a build with the feature `proj`, reproject the tiles (gdalwarp -t_srs EPSG:...), or name another CRS with `--crs` if the tile's own statement is wrong".to_owned(),
        }),
    }
}

impl Area {
    /// Corners and centre.
    fn samples(&self) -> Vec<LonLat> {
        let (lon_deg, lat_deg) = self.centre();
        let [west, south, east, north] = self.bounds();
        let corner = |lon_deg, lat_deg| LonLat { lon_deg, lat_deg };
        vec![
            LonLat { lon_deg, lat_deg },
            corner(west, south),
            corner(east, south),
            corner(east, north),
            corner(west, north),
        ]
    }
}
