//! `transforms.json`: what NeRF, instant-ngp and nerfstudio write.
//!
//! `transform_matrix` goes from the camera's OpenGL axes (x right, y up, z backward) to the world. Intrinsics
//! count from the picture's upper left corner.

use super::{CameraError, FileCamera, Source, content, is_rotation, picture_name, pinhole};
use serde_json::{Map, Value};
use std::path::Path;

/// Coefficients of lens distortion that must be absent or zero.
const DISTORTION: [&str; 8] = ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"];
/// Models that are a pinhole where the coefficients are zero.
const PINHOLES: [&str; 3] = ["PINHOLE", "SIMPLE_PINHOLE", "OPENCV"];

pub(super) fn read(
    path: &Path,
    size: Option<[u32; 2]>,
    source: &mut Source,
) -> Result<Vec<FileCamera>, CameraError> {
    let bytes = source.read(path)?;
    let file: Value =
        serde_json::from_slice(&bytes).map_err(|error| content(path, "not JSON", error))?;
    let Some(Value::Array(frames)) = file.get("frames") else {
        return Err(content(path, "`frames`", "missing; is this a transforms.json?"));
    };
    if let Some(applied) = file.get("applied_transform") {
        let rows = matrix(applied).ok_or_else(|| {
            content(path, "`applied_transform`", format!("{applied} is no matrix of 3 x 4 numbers"))
        })?;
        let identity = (0..3).all(|i| (0..4).all(|j| rows[i][j] == f64::from(i == j)));
        if !identity {
            let why = "the cameras are not in the world that they were made in; undo it, so that the \
                       world is east, north and up in metres, and take the key out";
            return Err(content(path, "`applied_transform`", why));
        }
    }
    if let Some(scale) = file.get("applied_scale").filter(|scale| scale.as_f64() != Some(1.0)) {
        let why =
            format!("{scale}: the world is not in metres any more; undo it and take the key out");
        return Err(content(path, "`applied_scale`", why));
    }
    let empty = Map::new();
    let common = file.as_object().unwrap_or(&empty);
    let mut cameras = Vec::with_capacity(frames.len());
    for (index, frame) in frames.iter().enumerate() {
        let frame = Frame { path, size, common, own: frame.as_object().unwrap_or(&empty), index };
        cameras.push(frame.camera()?);
    }
    Ok(cameras)
}

struct Frame<'a> {
    path: &'a Path,
    size: Option<[u32; 2]>,
    common: &'a Map<String, Value>,
    own: &'a Map<String, Value>,
    index: usize,
}

impl Frame<'_> {
    fn place(&self) -> String {
        match self.own.get("file_path").and_then(Value::as_str) {
            Some(name) => format!("frame {} (`{name}`)", self.index),
            None => format!("frame {}", self.index),
        }
    }

    fn fail(&self, why: impl std::fmt::Display) -> CameraError {
        content(self.path, &self.place(), why)
    }

    /// A number of the frame, or else of the whole file.
    fn number(&self, key: &str) -> Result<Option<f64>, CameraError> {
        match self.own.get(key).or_else(|| self.common.get(key)) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => match value.as_f64() {
                Some(number) => Ok(Some(number)),
                None => Err(self.fail(format!("`{key}` is {value}, not a number"))),
            },
        }
    }

    fn camera(&self) -> Result<FileCamera, CameraError> {
        self.check_model()?;
        let Some(value) = self.own.get("transform_matrix") else {
            return Err(self.fail("`transform_matrix` is missing"));
        };
        let rows = matrix(value).ok_or_else(|| {
            self.fail(format!("`transform_matrix` is no matrix of 4 x 4 numbers: {value}"))
        })?;
        let opengl = [0, 1, 2].map(|row| [rows[row][0], rows[row][1], rows[row][2]]);
        if !is_rotation(&opengl) {
            return Err(self.fail(
                "the left 3 x 3 part of `transform_matrix` is no rotation (it is scaled, sheared or \
                 mirrored)",
            ));
        }
        let name = match self.own.get("file_path").and_then(Value::as_str) {
            Some(name) => picture_name(name),
            None => format!("{:04}", self.index),
        };
        Ok(FileCamera {
            name,
            optics: self.optics()?,
            position: [rows[0][3], rows[1][3], rows[2][3]],
            rotation: opengl.map(|[right, up, back]| [right, -up, -back]),
        })
    }

    fn check_model(&self) -> Result<(), CameraError> {
        let refuse = |model: String| CameraError::Model {
            path: self.path.to_owned(),
            place: self.place(),
            model,
        };
        let model = self.own.get("camera_model").or_else(|| self.common.get("camera_model"));
        if let Some(model) = model.filter(|model| !model.is_null()) {
            let name = model.as_str().map_or_else(|| model.to_string(), str::to_owned);
            if !PINHOLES.contains(&name.as_str()) {
                return Err(refuse(name));
            }
        }
        if self.common.get("is_fisheye").and_then(Value::as_bool) == Some(true) {
            return Err(refuse("fisheye".to_owned()));
        }
        for key in DISTORTION {
            if let Some(value) = self.number(key)?.filter(|value| *value != 0.0) {
                return Err(refuse(format!("with distortion {key} = {value}")));
            }
        }
        Ok(())
    }

    fn optics(&self) -> Result<super::Optics, CameraError> {
        let stated = [self.number("w")?, self.number("h")?];
        let size = match (stated, self.size) {
            ([Some(w), Some(h)], _) => [w, h].map(|side| side as u32),
            (_, Some(size)) => size,
            _ => return Err(self.fail("`w` and `h` are missing; give --size")),
        };
        let [width, height] = size.map(f64::from);
        let focal = |key: &str, angle: &str, side: f64| -> Result<Option<f64>, CameraError> {
            match self.number(key)? {
                Some(focal) => Ok(Some(focal)),
                None => Ok(self.number(angle)?.map(|angle| side / 2.0 / libm::tan(angle / 2.0))),
            }
        };
        let Some(fx) = focal("fl_x", "camera_angle_x", width)? else {
            return Err(
                self.fail("neither `fl_x` nor `camera_angle_x` says how wide the camera looks")
            );
        };
        // Pixels are square where nothing else is said.
        let fy = focal("fl_y", "camera_angle_y", height)?.unwrap_or(fx);
        let cx = self.number("cx")?.unwrap_or(width / 2.0);
        let cy = self.number("cy")?.unwrap_or(height / 2.0);
        Ok(pinhole(size, [fx, fy, cx, cy]))
    }
}

/// The upper three rows of a matrix of finite numbers; a fourth row must be 0, 0, 0, 1.
fn matrix(value: &Value) -> Option<[[f64; 4]; 3]> {
    let rows = value.as_array()?;
    let row = |row: &Value| -> Option<[f64; 4]> {
        let numbers: Option<Vec<f64>> = row.as_array()?.iter().map(Value::as_f64).collect();
        <[f64; 4]>::try_from(numbers?).ok().filter(|row| row.iter().all(|v| v.is_finite()))
    };
    if let Some(last) = rows.get(3)
        && row(last)? != [0.0, 0.0, 0.0, 1.0]
    {
        return None;
    }
    match rows.len() {
        3 | 4 => Some([row(&rows[0])?, row(&rows[1])?, row(&rows[2])?]),
        _ => None,
    }
}
