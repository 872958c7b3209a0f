//! What a WKT definition means: a code, or parameters that the table knows.

use super::tree::Node;
use crate::crs::identify::{Definition, datum_by_code, datum_by_name};
use crate::crs::table::Method;
use crate::crs::vertical;
use crate::crs::{CrsError, CrsSpec, VerticalCrs};
use crate::units::LinearUnit;

const PROJECTED: [&str; 3] = ["PROJCS", "PROJCRS", "PROJECTEDCRS"];
const GEOGRAPHIC: [&str; 4] = ["GEOGCS", "GEOGCRS", "GEOGRAPHICCRS", "BASEGEOGCRS"];
const GEODETIC: [&str; 5] = ["GEODCRS", "GEODETICCRS", "BASEGEODCRS", "GEOCCS", "GEOGTRAN"];
const VERTICAL: [&str; 4] = ["VERT_CS", "VERTCRS", "VERTICALCRS", "VERTCS"];
const COMPOUND: [&str; 2] = ["COMPD_CS", "COMPOUNDCRS"];
const UNITS: [&str; 3] = ["UNIT", "LENGTHUNIT", "ANGLEUNIT"];

/// Reads a WKT definition.
pub(in crate::crs) fn spec_from_wkt(wkt: &str) -> Result<CrsSpec, CrsError> {
    let malformed = |reason: String| CrsError::Malformed {
        input: wkt.trim().chars().take(60).collect(),
        reason,
    };
    let root = Node::parse(wkt).map_err(malformed)?;
    let mut spec = crs(&root)?.ok_or_else(|| {
        malformed(format!("{} is no projected, geographic or compound CRS", root.keyword))
    })?;
    spec.wkt = Some(wkt.trim().to_owned());
    Ok(spec)
}

/// A CRS node, or `None` where it is of no use here.
fn crs(node: &Node) -> Result<Option<CrsSpec>, CrsError> {
    if node.is(&COMPOUND) {
        let mut parts = node.children();
        let horizontal = parts.find_map(|part| crs(part).transpose()).transpose()?;
        let upright = node.children().find(|part| part.is(&VERTICAL));
        return Ok(horizontal.map(|spec| CrsSpec { vertical: upright.map(vertical_crs), ..spec }));
    }
    if node.is(&["BOUNDCRS"]) {
        let source = node.child(&["SOURCECRS"]).and_then(|source| source.children().next());
        return source.map_or(Ok(None), crs);
    }
    if node.is(&PROJECTED) {
        return projected(node).map(Some);
    }
    let geocentric = node.is(&["GEOCCS"])
        || node.child(&["CS"]).and_then(|cs| cs.values.first()).is_some_and(
            |kind| matches!(kind, super::tree::Value::Word(word) if word.eq_ignore_ascii_case("cartesian")),
        );
    if !geocentric && (node.is(&GEOGRAPHIC) || node.is(&GEODETIC)) {
        return Ok(Some(CrsSpec {
            name: node.name().unwrap_or("unnamed").to_owned(),
            epsg: node.epsg(),
            geographic: true,
            linear_unit: None,
            vertical: None,
            wkt: None,
        }));
    }
    Ok(None)
}

fn projected(node: &Node) -> Result<CrsSpec, CrsError> {
    let unit = axis_unit(node);
    let definition = Definition {
        name: node.name().unwrap_or("unnamed").to_owned(),
        epsg: node.epsg(),
        datum: datum(node),
        method: method(node, unit),
        metres_per_unit: unit,
    };
    let mut spec = definition.identify()?;
    // ESRI writes heights as a second definition inside the projected one; a comma apart in files,
    // it arrives here as a child.
    spec.vertical = node.children().find(|part| part.is(&VERTICAL)).map(vertical_crs);
    Ok(spec)
}

/// EPSG code of the base CRS's datum family, as the table names bases.
fn datum(node: &Node) -> Option<u32> {
    let bases = [GEOGRAPHIC.as_slice(), GEODETIC.as_slice()].concat();
    let base = node.child(&bases)?;
    let meridian = base.child(&["PRIMEM", "PRIMEMERIDIAN"]).or(node.child(&["PRIMEM"]));
    if meridian.and_then(|node| node.number(1)).is_some_and(|degrees| degrees != 0.0) {
        return None;
    }
    let datum = base.child(&["DATUM", "GEODETICDATUM", "TRF", "ENSEMBLE"]);
    let code = base.epsg().or_else(|| datum.and_then(Node::epsg));
    code.and_then(datum_by_code)
        .or_else(|| datum.and_then(Node::name).and_then(datum_by_name))
        .or_else(|| base.name().and_then(datum_by_name))
}

/// Metres per unit of a projected node's axes: its own unit, that of its coordinate system's axes in
/// WKT 2.
fn axis_unit(node: &Node) -> Option<f64> {
    let own = node.children().find(|child| child.is(&["UNIT", "LENGTHUNIT"]));
    let of_axis = || {
        node.children()
            .filter(|child| child.is(&["AXIS"]))
            .find_map(|axis| axis.children().find(|child| child.is(&["UNIT", "LENGTHUNIT"])))
    };
    own.or_else(of_axis).and_then(|unit| unit.number(1)).filter(|metres| *metres > 0.0)
}

/// Projection parameters in metres and degrees, if the method is one of the table's.
fn method(node: &Node, unit: Option<f64>) -> Option<Method> {
    let conversion = node.child(&["CONVERSION"]).unwrap_or(node);
    let name = key(conversion.child(&["PROJECTION", "METHOD"])?.name()?);
    let unit = unit?;
    // WKT 1 gives angles in the base CRS's unit, WKT 2 with a unit of their own.
    let degree = 1.0_f64.to_radians();
    let bases = [GEOGRAPHIC.as_slice(), GEODETIC.as_slice()].concat();
    let angle_unit = node
        .child(&bases)
        .and_then(|base| base.child(&["UNIT", "ANGLEUNIT"]))
        .and_then(|unit| unit.number(1))
        .unwrap_or(degree);
    let find = |names: &[&str]| {
        conversion
            .children()
            .filter(|child| child.is(&["PARAMETER"]))
            .find(|child| child.name().is_some_and(|name| names.contains(&key(name).as_str())))
    };
    let own_unit = |parameter: &Node| {
        parameter.children().find(|child| child.is(&UNITS)).and_then(|unit| unit.number(1))
    };
    let angle = |names: &[&str]| {
        let parameter = find(names)?;
        let unit = own_unit(parameter).unwrap_or(angle_unit);
        // The usual case must not pass through a factor that is 1 but for rounding.
        let exact = (unit / degree - 1.0).abs() < 1e-12;
        parameter.number(1).map(|value| if exact { value } else { (value * unit).to_degrees() })
    };
    let length = |names: &[&str]| {
        let parameter = find(names)?;
        parameter.number(1).map(|value| value * own_unit(parameter).unwrap_or(unit))
    };
    let scale = || {
        find(&["scalefactor", "scalefactoratnaturalorigin"])
            .and_then(|parameter| parameter.number(1))
    };
    let lat_0 = angle(&[
        "latitudeoforigin",
        "latitudeofnaturalorigin",
        "latitudeoffalseorigin",
        "latitudeofcenter",
        "centrallatitude",
    ]);
    let lon_0 = angle(&[
        "centralmeridian",
        "longitudeofnaturalorigin",
        "longitudeoffalseorigin",
        "longitudeoforigin",
        "longitudeofcenter",
    ])?;
    let lat_1 = angle(&["standardparallel1", "latitudeof1ststandardparallel"]);
    let lat_2 = angle(&["standardparallel2", "latitudeof2ndstandardparallel"]);
    let x_0 = length(&["falseeasting", "eastingatfalseorigin"]).unwrap_or(0.0);
    let y_0 = length(&["falsenorthing", "northingatfalseorigin"]).unwrap_or(0.0);
    let k_0 = scale().unwrap_or(1.0);
    match name.as_str() {
        "transversemercator" | "gausskruger" => {
            Some(Method::TransverseMercator { lat_0: lat_0.unwrap_or(0.0), lon_0, k_0, x_0, y_0 })
        }
        "lambertconformalconic2sp" | "lambertconicconformal2sp" => {
            Some(Method::Conic2 { lat_0: lat_0?, lon_0, lat_1: lat_1?, lat_2: lat_2?, x_0, y_0 })
        }
        "lambertconformalconic1sp" | "lambertconicconformal1sp" => {
            Some(Method::Conic1 { lat_0: lat_0?, lon_0, k_0, x_0, y_0 })
        }
        // ESRI's one name for both: a scale goes with one parallel, which it writes twice over.
        "lambertconformalconic" => match (lat_1, lat_2) {
            (Some(lat_1), Some(lat_2)) if k_0 == 1.0 => {
                Some(Method::Conic2 { lat_0: lat_0?, lon_0, lat_1, lat_2, x_0, y_0 })
            }
            (Some(lat_1), None) if lat_0.is_none_or(|lat_0| (lat_0 - lat_1).abs() < 1e-9) => {
                Some(Method::Conic1 { lat_0: lat_1, lon_0, k_0, x_0, y_0 })
            }
            _ => None,
        },
        _ => None,
    }
}

/// A name without case, blanks and punctuation.
fn key(name: &str) -> String {
    name.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect()
}

fn vertical_crs(node: &Node) -> VerticalCrs {
    let of_axis = || {
        node.children()
            .filter(|child| child.is(&["AXIS"]))
            .find_map(|axis| axis.children().find(|child| child.is(&["UNIT", "LENGTHUNIT"])))
    };
    let unit = node
        .child(&["UNIT", "LENGTHUNIT"])
        .or_else(of_axis)
        .and_then(|unit| unit.number(1))
        .and_then(LinearUnit::from_metres_per_unit);
    vertical::describe(node.epsg(), node.name(), unit)
}
