//! COLMAP's model folders, text or binary.
//!
//! Images hold the rotation (quaternion, scalar first) and the translation from the world to the
//! camera, whose axes are x right, y down, z forward. Intrinsics count from the upper left corner.

use super::{CameraError, FileCamera, Source, content, picture_name, pinhole};
use crate::model::render::frames::Matrix;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// COLMAP's camera models by number; the first two are pinholes.
const MODELS: [&str; 18] = [
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
];

/// A camera as COLMAP has it, one for many images.
struct Sensor {
    model: String,
    size: [u64; 2],
    parameters: Vec<f64>,
}

struct Image {
    id: u32,
    quaternion: [f64; 4],
    translation: [f64; 3],
    sensor: u32,
    name: String,
}

pub(super) fn read(folder: &Path, source: &mut Source) -> Result<Vec<FileCamera>, CameraError> {
    let folders = [folder.to_owned(), folder.join("sparse/0")];
    let found = folders.iter().find_map(|folder| {
        ["bin", "txt"].into_iter().find_map(|ending| {
            let file = |name: &str| folder.join(format!("{name}.{ending}"));
            let (cameras, images) = (file("cameras"), file("images"));
            (cameras.is_file() && images.is_file()).then_some((cameras, images, ending))
        })
    });
    let Some((cameras, images, ending)) = found else {
        return Err(CameraError::NoModel { path: folder.to_owned() });
    };
    let (sensors, mut list) = if ending == "bin" {
        (
            binary_cameras(&mut Bytes::open(&cameras, source)?)?,
            binary_images(&mut Bytes::open(&images, source)?)?,
        )
    } else {
        (text_cameras(&cameras, source)?, text_images(&images, source)?)
    };
    list.sort_by_key(|image| image.id);
    list.iter().map(|image| camera(image, &sensors, &images, &cameras)).collect()
}

fn camera(
    image: &Image,
    sensors: &HashMap<u32, Sensor>,
    images: &Path,
    cameras: &Path,
) -> Result<FileCamera, CameraError> {
    let place = format!("image {} (`{}`)", image.id, image.name);
    let Some(sensor) = sensors.get(&image.sensor) else {
        return Err(content(images, &place, format!("no camera {} in the model", image.sensor)));
    };
    let intrinsics = match (sensor.model.as_str(), &sensor.parameters[..]) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => [f, f, cx, cy],
        ("PINHOLE", &[fx, fy, cx, cy]) => [fx, fy, cx, cy],
        ("SIMPLE_PINHOLE" | "PINHOLE", parameters) => {
            let why = format!("{} with {} parameters", sensor.model, parameters.len());
            return Err(content(cameras, &format!("camera {}", image.sensor), why));
        }
        (model, _) => {
            return Err(CameraError::Model {
                path: cameras.to_owned(),
                place: format!("camera {}", image.sensor),
                model: model.to_owned(),
            });
        }
    };
    let Some(to_camera) = rotation(image.quaternion) else {
        let why = format!("the quaternion {:?} is no rotation", image.quaternion);
        return Err(content(images, &place, why));
    };
    let t = image.translation;
    if !t.iter().all(|v| v.is_finite()) {
        return Err(content(images, &place, format!("the translation is {t:?}")));
    }
    // The inverse of a rotation is its transpose; the camera stands at -R^T t.
    let to_world: Matrix = [0, 1, 2].map(|row| [0, 1, 2].map(|column| to_camera[column][row]));
    let position = to_world.map(|row| 0.0 - (row[0] * t[0] + row[1] * t[1] + row[2] * t[2]));
    let size = sensor.size.map(|side| u32::try_from(side).unwrap_or(u32::MAX));
    Ok(FileCamera {
        name: picture_name(&image.name),
        optics: pinhole(size, intrinsics),
        position,
        rotation: to_world,
    })
}

/// Of a quaternion (w, x, y, z) of any length.
fn rotation(quaternion: [f64; 4]) -> Option<Matrix> {
    let length = quaternion.iter().map(|v| v * v).sum::<f64>().sqrt();
    if !(length > 0.0 && length.is_finite()) {
        return None;
    }
    let [w, x, y, z] = quaternion.map(|v| v / length);
    Some([
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ])
}

fn text(path: &Path, source: &mut Source) -> Result<String, CameraError> {
    String::from_utf8(source.read(path)?).map_err(|error| content(path, "not UTF-8 text", error))
}

/// A word of a line as a value.
fn word<T: std::str::FromStr>(
    path: &Path,
    line: usize,
    words: &[&str],
    index: usize,
    what: &str,
) -> Result<T, CameraError> {
    let place = format!("line {}", line + 1);
    let Some(word) = words.get(index) else {
        return Err(content(path, &place, format!("{what} is missing")));
    };
    word.parse().map_err(|_| content(path, &place, format!("{what} is `{word}`")))
}

fn text_cameras(path: &Path, source: &mut Source) -> Result<HashMap<u32, Sensor>, CameraError> {
    let text = text(path, source)?;
    let mut sensors = HashMap::new();
    for (line, row) in text.lines().enumerate() {
        let words: Vec<&str> = row.split_whitespace().collect();
        if words.is_empty() || words[0].starts_with('#') {
            continue;
        }
        let id = word(path, line, &words, 0, "the camera's number")?;
        let model: String = word(path, line, &words, 1, "the camera's model")?;
        let size =
            [word(path, line, &words, 2, "the width")?, word(path, line, &words, 3, "the height")?];
        let parameters = (4..words.len())
            .map(|index| word(path, line, &words, index, "a parameter"))
            .collect::<Result<_, _>>()?;
        sensors.insert(id, Sensor { model, size, parameters });
    }
    Ok(sensors)
}

fn text_images(path: &Path, source: &mut Source) -> Result<Vec<Image>, CameraError> {
    let text = text(path, source)?;
    let mut images = Vec::new();
    let mut lines = text.lines().enumerate();
    while let Some((line, row)) = lines.next() {
        let words: Vec<&str> = row.split_whitespace().collect();
        if words.is_empty() || words[0].starts_with('#') {
            continue;
        }
        let number = |index, what| word::<f64>(path, line, &words, index, what);
        images.push(Image {
            id: word(path, line, &words, 0, "the image's number")?,
            quaternion: [number(1, "QW")?, number(2, "QX")?, number(3, "QY")?, number(4, "QZ")?],
            translation: [number(5, "TX")?, number(6, "TY")?, number(7, "TZ")?],
            sensor: word(path, line, &words, 8, "the camera's number")?,
            // Names may hold spaces.
            name: words.get(9..).unwrap_or_default().join(" "),
        });
        // The points of the image, an empty line where there are none.
        lines.next();
    }
    Ok(images)
}

/// A binary file, read from the front.
struct Bytes {
    path: PathBuf,
    bytes: Vec<u8>,
    at: usize,
}

impl Bytes {
    fn open(path: &Path, source: &mut Source) -> Result<Self, CameraError> {
        Ok(Self { path: path.to_owned(), bytes: source.read(path)?, at: 0 })
    }

    fn fail(&self, why: impl std::fmt::Display) -> CameraError {
        content(&self.path, &format!("byte {}", self.at), why)
    }

    fn take(&mut self, count: u64) -> Result<&[u8], CameraError> {
        let end = usize::try_from(count).ok().and_then(|count| self.at.checked_add(count));
        match end.filter(|end| *end <= self.bytes.len()) {
            Some(end) => {
                let from = std::mem::replace(&mut self.at, end);
                Ok(&self.bytes[from..end])
            }
            None => Err(self.fail(format!("the file ends {count} bytes too early"))),
        }
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], CameraError> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N as u64)?);
        Ok(array)
    }

    fn u32(&mut self) -> Result<u32, CameraError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    fn u64(&mut self) -> Result<u64, CameraError> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N], CameraError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.array()?);
        }
        Ok(values)
    }
}

fn binary_cameras(file: &mut Bytes) -> Result<HashMap<u32, Sensor>, CameraError> {
    let mut sensors = HashMap::new();
    for _ in 0..file.u64()? {
        let (id, model) = (file.u32()?, file.u32()?);
        let size = [file.u64()?, file.u64()?];
        let parameters = match model {
            0 => file.f64s::<3>()?.to_vec(),
            1 => file.f64s::<4>()?.to_vec(),
            other => {
                let name = MODELS.get(other as usize).copied();
                let model = name.map_or_else(|| format!("number {other}"), str::to_owned);
                let (path, place) = (file.path.clone(), format!("camera {id}"));
                return Err(CameraError::Model { path, place, model });
            }
        };
        let model = MODELS[model as usize].to_owned();
        sensors.insert(id, Sensor { model, size, parameters });
    }
    Ok(sensors)
}

fn binary_images(file: &mut Bytes) -> Result<Vec<Image>, CameraError> {
    let mut images = Vec::new();
    for _ in 0..file.u64()? {
        let id = file.u32()?;
        let (quaternion, translation) = (file.f64s()?, file.f64s()?);
        let sensor = file.u32()?;
        let mut name = Vec::new();
        loop {
            match file.array::<1>()? {
                [0] => break,
                [byte] => name.push(byte),
            }
        }
        let points = file.u64()?;
        let bytes = points.checked_mul(24).ok_or_else(|| file.fail(format!("{points} points")))?;
        file.take(bytes)?;
        let name = String::from_utf8_lossy(&name).into_owned();
        images.push(Image { id, quaternion, translation, sensor, name });
    }
    Ok(images)
}
