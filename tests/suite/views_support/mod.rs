//! What the tests of views share: the city of boxes, pictures, arrays.
#![allow(dead_code, reason = "each test file uses a part")]

use sat3d::footprint::Footprint;
use sat3d::grid::{ImageGrid, LonLat};
use sat3d::model::field::closed_form::BoxCity;
use sat3d::model::scene::{SceneParts, SkyParts};
use sat3d::model::{Grid, Scene};
use sat3d::raster::npz;
use sat3d::views::{NamedFile, ViewContext, ViewRequests, render};
use std::path::Path;

/// The sky's colour in every direction above 100 degrees from the zenith.
pub const SKY: [f32; 3] = [0.25, 0.5, 0.75];
/// As bytes: 255 times, cut off.
pub const SKY_BYTES: [u8; 3] = [63, 127, 191];

/// A tower in the north-east, a hall in the south, a low house in the west; heights 32.24 m a unit.
pub fn city() -> Scene {
    let (inputs, head) = BoxCity::example().inputs();
    let data = SKY.iter().flat_map(|value| vec![*value; 16 * 16]).collect();
    let sky = Some(SkyParts { style: vec![0.0], map: Grid::new(3, 16, 16, data) });
    Scene::new(SceneParts { inputs, head, sky, metres_per_unit: 32.24 }).expect("a scene")
}

/// A VIGOR image of Seattle: 640 pixels at zoom 20.
pub fn seattle() -> Footprint {
    let center = LonLat { lon_deg: -122.33, lat_deg: 47.6 };
    Footprint::of_grid(ImageGrid::new(center, 20, 640, 640).expect("a grid"))
}

/// The pixel of the image at a place of the cube's map frame.
pub fn pixel_of(x: f64, y: f64) -> [f64; 2] {
    [x, y].map(|v| (v / 0.8 + 1.0) * 320.0)
}

pub fn files(requests: &ViewRequests) -> Vec<NamedFile> {
    let (scene, footprint) = (city(), seattle());
    let context = ViewContext { scene: &scene, network: None, footprint: &footprint, stem: "city" };
    let files = render(requests, &context).unwrap_or_else(|error| panic!("{error}"));
    let paths: Vec<&str> = files.iter().map(|file| file.path.as_str()).collect();
    assert_eq!(paths, requests.files("city"), "the files that were announced");
    files
}

pub fn file<'a>(files: &'a [NamedFile], path: &str) -> &'a [u8] {
    let names = || files.iter().map(|f| f.path.as_str()).collect::<Vec<_>>().join(", ");
    let found = files.iter().find(|f| f.path == path);
    &found.unwrap_or_else(|| panic!("no {path} among {}", names())).bytes
}

/// A picture, with its pixels by row and column.
pub struct Pixels(image::RgbImage);

impl Pixels {
    pub fn of(files: &[NamedFile], path: &str) -> Self {
        Self(image::load_from_memory(file(files, path)).expect(path).to_rgb8())
    }

    pub fn size(&self) -> (u32, u32) {
        self.0.dimensions()
    }

    pub fn at(&self, row: usize, column: usize) -> [u8; 3] {
        self.0.get_pixel(column as u32, row as u32).0
    }

    /// Whether a pixel has the sky's colour, but for the little that is in the city's air.
    pub fn is_sky(&self, row: usize, column: usize) -> bool {
        let pixel = self.at(row, column);
        (0..3).all(|k| pixel[k].abs_diff(SKY_BYTES[k]) <= 4)
    }

    pub fn raw(&self) -> &[u8] {
        self.0.as_raw()
    }

    /// The largest difference of a byte.
    pub fn differs(&self, other: &Self) -> u8 {
        assert_eq!(self.size(), other.size());
        self.raw().iter().zip(other.raw()).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0)
    }
}

/// An array of an npz.
pub struct Array {
    pub shape: Vec<usize>,
    pub values: Vec<f32>,
}

impl Array {
    pub fn of(files: &[NamedFile], path: &str, key: &str) -> Self {
        let arrays = npz::parse(file(files, path), Path::new(path)).expect(path);
        let (_, array) = arrays.into_iter().find(|(name, _)| name == key).expect(key);
        Self { shape: array.shape.clone(), values: array.to_f32() }
    }

    pub fn at(&self, row: usize, column: usize) -> f64 {
        f64::from(self.values[row * self.shape[1] + column])
    }

    pub fn vector(&self, row: usize, column: usize) -> [f64; 3] {
        let first = 3 * (row * self.shape[1] + column);
        [0, 1, 2].map(|k| f64::from(self.values[first + k]))
    }
}
