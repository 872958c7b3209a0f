//! PROJ as the authority: every CRS outside the table, operations that the closed forms do not
//! have, and the check of the closed forms.

use super::proj::{Context, Kind, Object, Transform, version};
use super::resolve::Pinned;
use super::scale::ground_distance_m;
use super::table::Area;
use super::{
    CheckReport, CrsError, CrsSpec, OperationInfo, Projection, ResolveOptions, ResolvedCrs,
};
use crate::grid::{LonLat, Projected};
use crate::units::LinearUnit;
use std::rc::Rc;
use std::sync::{Arc, Mutex, PoisonError};

/// A pipeline run by PROJ. PROJ's objects serve one thread at a time and cost 10 to 60 ms to make,
/// so idle ones are kept and handed out: at most one for each thread that is projecting.
#[derive(Debug)]
pub(super) struct ProjProjection {
    name: String,
    pipeline: String,
    network: bool,
    idle: Mutex<Vec<Transform>>,
}

impl ProjProjection {
    fn new(name: String, pipeline: String, network: bool) -> Result<Self, CrsError> {
        let first = Transform::new(&pipeline, network)?;
        Ok(Self { name, pipeline, network, idle: Mutex::new(vec![first]) })
    }

    fn run(&self, at: (f64, f64), forward: bool) -> Result<Projected, CrsError> {
        let idle = || self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        let taken = idle().pop();
        let mut transform = match taken {
            Some(transform) => transform,
            None => Transform::new(&self.pipeline, self.network)?,
        };
        let result = transform.run(at, forward);
        idle().push(transform);
        result.map_err(|message| CrsError::Domain {
            projection: self.name.clone(),
            what: format!("{}, {} ({message})", at.0, at.1),
        })
    }
}

impl Projection for ProjProjection {
    fn forward(&self, at: LonLat) -> Result<Projected, CrsError> {
        self.run((at.lon_deg, at.lat_deg), true)
    }

    fn inverse(&self, at: Projected) -> Result<LonLat, CrsError> {
        let at = self.run((at.x, at.y), false)?;
        Ok(LonLat { lon_deg: at.x, lat_deg: at.y })
    }
}

/// The projected CRS of a specification, as PROJ knows it.
fn projected(context: &Rc<Context>, spec: &CrsSpec) -> Result<Object, CrsError> {
    let definition = match (spec.epsg, &spec.wkt) {
        (Some(code), _) => format!("EPSG:{code}"),
        (None, Some(wkt)) => wkt.clone(),
        (None, None) => {
            return Err(CrsError::Unsupported {
                name: spec.label(),
                reason:
                    "it has neither an EPSG code nor a definition; name a CRS with `--crs EPSG:...`"
                        .to_owned(),
            });
        }
    };
    let mut crs = context.create(&definition)?;
    if crs.kind() == Kind::Compound {
        crs = crs.horizontal()?;
    }
    let inner = if crs.kind() == Kind::Bound { Some(crs.source()?) } else { None };
    match inner.as_ref().unwrap_or(&crs).kind() {
        Kind::Projected => Ok(crs),
        Kind::Geographic => Err(CrsError::Geographic { name: spec.label() }),
        _ => Err(CrsError::Unsupported {
            name: spec.label(),
            reason: "it is no projected CRS; name one with `--crs EPSG:...`".to_owned(),
        }),
    }
}

/// One way that PROJ knows from WGS 84 to a CRS.
struct Candidate {
    operation: Object,
    accuracy_m: Option<f64>,
    usable: bool,
}

fn candidates(
    context: &Rc<Context>,
    target: &Object,
    options: &ResolveOptions,
) -> Result<Vec<Candidate>, CrsError> {
    let source = context.create("EPSG:4326")?;
    let found = context.operations(&source, target, options.area, options.proj_network)?;
    Ok(found
        .into_iter()
        .map(|operation| Candidate {
            accuracy_m: operation.accuracy_m(),
            usable: operation.is_instantiable(),
            operation,
        })
        .collect())
}

/// Resolves through PROJ.
pub(super) fn resolve(
    spec: &CrsSpec,
    pinned: Option<&Pinned<'_>>,
    options: &ResolveOptions,
) -> Result<ResolvedCrs, CrsError> {
    let context = Context::new(options.proj_network)?;
    let crs = projected(&context, spec)?;
    let found = candidates(&context, &crs, options)?;
    let refuse = |reason: String| CrsError::Operation {
        operation: options.operation.clone().unwrap_or_default(),
        name: spec.label(),
        reason,
    };
    let usable = || found.iter().filter(|candidate| candidate.usable);
    let chosen = match pinned {
        None => usable().find(|c| !c.operation.is_ballpark()).or_else(|| usable().next()),
        Some(Pinned::Ballpark) => usable().find(|c| c.operation.is_ballpark()),
        Some(Pinned::Code(code)) => {
            let name = context.operation(*code)?.name();
            let named = |c: &&Candidate| is_step_of(&name, &c.operation.name());
            let Some(candidate) = found.iter().find(named) else {
                return Err(refuse(format!("EPSG:{code} ({name}) is none of {}", listing(&found))));
            };
            if !candidate.usable {
                return Err(refuse(format!(
                    "it needs the grid {}; install it, or let PROJ fetch it with `--proj-network`",
                    missing_grids(candidate)
                )));
            }
            Some(candidate)
        }
        Some(Pinned::Pipeline(text)) => {
            return pipeline(spec, &crs, text, &found, options);
        }
    };
    let Some(chosen) = chosen else {
        return Err(refuse(format!("PROJ can run none of {}", listing(&found))));
    };
    let operation = chosen.operation.normalised()?;
    let definition = operation.pipeline()?;
    let info = OperationInfo {
        name: chosen.operation.name(),
        code: pinned.and_then(|p| match p {
            Pinned::Code(code) => Some(*code),
            _ => None,
        }),
        accuracy_m: chosen.accuracy_m,
        grids: chosen.operation.grids().into_iter().map(|grid| grid.name).collect(),
        definition,
        datum_shift_m: 0.0,
        provider: format!("PROJ {}", version()),
    };
    let warnings = warnings(spec, chosen, &info.definition, &found, pinned.is_some());
    finish(spec, &crs, info, warnings, options)
}

/// Serves a pipeline that the user gave, if it leads to the CRS.
fn pipeline(
    spec: &CrsSpec,
    crs: &Object,
    text: &str,
    found: &[Candidate],
    options: &ResolveOptions,
) -> Result<ResolvedCrs, CrsError> {
    // `projinfo` prints pipelines that begin with latitude; here longitude always comes first.
    let swap = ["+step", "+proj=axisswap", "+order=2,1"];
    let words: Vec<&str> = text.split_whitespace().collect();
    let definition = match words.get(1..4) {
        Some(step) if step == swap => {
            words[..1].iter().chain(&words[4..]).copied().collect::<Vec<_>>().join(" ")
        }
        _ => words.join(" "),
    };
    let info = OperationInfo {
        name: "pipeline given by the user".to_owned(),
        code: None,
        accuracy_m: None,
        grids: words.iter().filter_map(|w| w.strip_prefix("+grids=")).map(str::to_owned).collect(),
        definition,
        datum_shift_m: 0.0,
        provider: format!("PROJ {}", version()),
    };
    let warning = format!("{}: the accuracy of the pipeline given is not stated", spec.label());
    let resolved = finish(spec, crs, info, vec![warning], options)?;
    let Some(at) = measuring_point(options, crs) else {
        return Ok(resolved);
    };
    // A pipeline that leads elsewhere (other units, other axes, another zone) would put the work
    // kilometres away without a word.
    const FAR_M: f64 = 1000.0;
    if let Some(candidate) = found.iter().find(|c| c.usable) {
        let usual = candidate.operation.normalised()?.pipeline()?;
        let usual = ProjProjection::new(spec.label(), usual, options.proj_network)?;
        let (a, b) = (resolved.projection.forward(at)?, usual.forward(at)?);
        let apart = libm::hypot(a.x - b.x, a.y - b.y) * resolved.metres_per_unit;
        if apart > FAR_M {
            return Err(CrsError::Operation {
                operation: text.to_owned(),
                name: spec.label(),
                reason: format!(
                    "it lands {:.0} km from where the CRS puts the position {} {}; a pipeline takes longitude and latitude in degrees and gives easting and northing in the CRS's own unit",
                    apart / 1000.0,
                    at.lon_deg,
                    at.lat_deg
                ),
            });
        }
    }
    Ok(resolved)
}

/// Fills in what the CRS says about itself, and measures the datum step.
fn finish(
    spec: &CrsSpec,
    crs: &Object,
    mut operation: OperationInfo,
    warnings: Vec<String>,
    options: &ResolveOptions,
) -> Result<ResolvedCrs, CrsError> {
    let inner = if crs.kind() == Kind::Bound { Some(crs.source()?) } else { None };
    let crs = inner.as_ref().unwrap_or(crs);
    let metres_per_unit = crs.axis_unit()?;
    let network = options.proj_network;
    let make = |pipeline: String| ProjProjection::new(crs.name(), pipeline, network);
    let without = without_datum_steps(&operation.definition);
    if options.without_datum_step {
        operation.definition = without;
    } else if without != operation.definition {
        let (with, without) = (make(operation.definition.clone())?, make(without)?);
        if let Some(at) = measuring_point(options, crs) {
            let moved = without.inverse(with.forward(at)?)?;
            operation.datum_shift_m = ground_distance_m(at, moved);
        }
    }
    let projection = make(operation.definition.clone())?;
    let epsg = spec.epsg.or_else(|| crs.epsg());
    Ok(ResolvedCrs {
        spec: CrsSpec {
            name: if epsg.is_some() { crs.name() } else { spec.name.clone() },
            epsg,
            geographic: false,
            linear_unit: LinearUnit::from_metres_per_unit(metres_per_unit),
            vertical: spec.vertical.clone(),
            wkt: if epsg.is_some() { None } else { spec.wkt.clone() },
        },
        metres_per_unit,
        operation,
        projection: Arc::new(projection),
        warnings,
    })
}

/// Centre of the work, or of the CRS's area of use.
fn measuring_point(options: &ResolveOptions, crs: &Object) -> Option<LonLat> {
    let area = options.area.or_else(|| crs.area_of_use())?;
    let (lon_deg, lat_deg) = Area::new(area).centre();
    Some(LonLat { lon_deg, lat_deg })
}

/// A pipeline without the steps that lead from one datum to another.
fn without_datum_steps(pipeline: &str) -> String {
    const DATUM_STEPS: [&str; 9] = [
        "push",
        "pop",
        "cart",
        "helmert",
        "molobadekas",
        "hgridshift",
        "vgridshift",
        "gridshift",
        "geocent",
    ];
    let is_datum_step = |step: &str| {
        let name = step.split_whitespace().find_map(|word| word.strip_prefix("+proj="));
        name.is_some_and(|name| DATUM_STEPS.contains(&name))
    };
    let mut steps = pipeline.split(" +step ");
    let mut kept: Vec<&str> = steps.by_ref().take(1).collect();
    kept.extend(steps.filter(|step| !is_datum_step(step)));
    kept.join(" +step ")
}

/// Whether an operation, as PROJ names it, contains a datum step of this name.
fn is_step_of(step: &str, operation: &str) -> bool {
    operation
        .split(" + ")
        .any(|part| part == step || part.strip_prefix("Inverse of ") == Some(step))
}

fn missing_grids(candidate: &Candidate) -> String {
    let missing = candidate.operation.grids().into_iter().filter(|grid| !grid.available);
    missing.map(|grid| grid.name).collect::<Vec<_>>().join(", ")
}

fn listing(found: &[Candidate]) -> String {
    let describe = |candidate: &Candidate| {
        let accuracy = match candidate.accuracy_m {
            Some(metres) => format!("{metres} m"),
            None => "unknown accuracy".to_owned(),
        };
        let missing = missing_grids(candidate);
        let missing = if missing.is_empty() { missing } else { format!(", needs {missing}") };
        format!("`{}` ({accuracy}{missing})", candidate.operation.name())
    };
    match found {
        [] => "its operations (it knows none)".to_owned(),
        _ => found.iter().map(describe).collect::<Vec<_>>().join("; "),
    }
}

fn warnings(
    spec: &CrsSpec,
    chosen: &Candidate,
    definition: &str,
    found: &[Candidate],
    pinned: bool,
) -> Vec<String> {
    let crs = spec.label();
    let mut warnings = Vec::new();
    let null = without_datum_steps(definition) == definition;
    if chosen.operation.is_ballpark() {
        warnings.push(format!(
            "{crs}: its datum is taken to equal WGS 84, because PROJ knows no operation between them; how many metres that is off, nobody states"
        ));
    } else if let Some(metres) = chosen.accuracy_m.filter(|metres| null && *metres > 0.0) {
        warnings.push(format!(
            "{crs}: its datum is taken to equal WGS 84 ({}, a null shift): positions are good to {metres} m at best",
            chosen.operation.name()
        ));
    }
    let metres = |candidate: &Candidate| candidate.accuracy_m.unwrap_or(f64::INFINITY);
    let better = found
        .iter()
        .filter(|candidate| !candidate.usable && metres(candidate) < metres(chosen))
        .min_by(|a, b| metres(a).total_cmp(&metres(b)));
    // Whoever pinned an operation has chosen.
    if let Some(better) = better.filter(|_| !pinned) {
        let stated = match chosen.accuracy_m {
            Some(metres) => format!("{metres} m"),
            None => "an unknown number of metres".to_owned(),
        };
        warnings.push(format!(
            "{crs}: `{}` would be good to {} m instead of {stated}, but needs {}; install the grid or use `--proj-network`",
            better.operation.name(),
            metres(better),
            missing_grids(better)
        ));
    }
    warnings
}

/// WKT of a CRS, from whatever PROJ understands.
pub(super) fn wkt_of(text: &str) -> Result<String, CrsError> {
    let crs = Context::new(false)?.create(text)?;
    let is_crs = !matches!(crs.kind(), Kind::Other);
    crs.wkt().filter(|_| is_crs).ok_or_else(|| CrsError::Proj {
        action: format!("understand `{text}`"),
        message: "it is no CRS".to_owned(),
    })
}

/// Compares a resolved CRS with PROJ, at the given positions: with PROJ's own form of the same
/// operation, and with the operation that PROJ picks by itself for the area of the positions.
///
/// Positions that either side cannot project are left out and not counted.
///
/// # Errors
/// [`CrsError`] when PROJ knows no operation at all.
pub fn check_against_proj(
    resolved: &ResolvedCrs,
    points: &[LonLat],
) -> Result<CheckReport, CrsError> {
    compare(&Context::new(false)?, resolved, points)
}

fn compare(
    context: &Rc<Context>,
    resolved: &ResolvedCrs,
    points: &[LonLat],
) -> Result<CheckReport, CrsError> {
    let options = ResolveOptions { area: bounds(points), ..ResolveOptions::default() };
    let crs = projected(context, &resolved.spec)?;
    let found = candidates(context, &crs, &options)?;
    let usable = || found.iter().filter(|candidate| candidate.usable);
    let Some(default) = usable().find(|c| !c.operation.is_ballpark()).or_else(|| usable().next())
    else {
        return Err(CrsError::Unsupported {
            name: resolved.spec.label(),
            reason: format!("PROJ can run none of {}", listing(&found)),
        });
    };
    let same = usable().find(|candidate| candidate.operation.name() == resolved.operation.name);
    let same = match same {
        Some(candidate) => candidate.operation.normalised()?,
        None => context.create(&resolved.operation.definition)?,
    };
    let usual = default.operation.normalised()?;
    let mut report = CheckReport {
        points: 0,
        same_operation_m: 0.0,
        default_operation_m: 0.0,
        default_operation: default.operation.name(),
        proj_version: version(),
    };
    for point in points {
        let at = (point.lon_deg, point.lat_deg);
        let (Ok(here), Ok(same), Ok(usual)) =
            (resolved.projection.forward(*point), same.run(at, true), usual.run(at, true))
        else {
            continue;
        };
        let apart = |other: Projected| {
            libm::hypot(here.x - other.x, here.y - other.y) * resolved.metres_per_unit
        };
        report.points += 1;
        report.same_operation_m = report.same_operation_m.max(apart(same));
        report.default_operation_m = report.default_operation_m.max(apart(usual));
    }
    Ok(report)
}

/// West, south, east, north of positions that do not cross the antimeridian.
fn bounds(points: &[LonLat]) -> Option<[f64; 4]> {
    let first = points.first()?;
    let mut area = [first.lon_deg, first.lat_deg, first.lon_deg, first.lat_deg];
    for point in points {
        area[0] = area[0].min(point.lon_deg);
        area[1] = area[1].min(point.lat_deg);
        area[2] = area[2].max(point.lon_deg);
        area[3] = area[3].max(point.lat_deg);
    }
    Some(area)
}

#[cfg(test)]
mod tests;
