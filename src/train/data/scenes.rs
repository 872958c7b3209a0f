//! Simulated scenes as the training keeps them: in memory, and in a cache folder.

use crate::batch::write_atomic;
use crate::random::Draw;
use crate::scene::pixels::PixelPositions;
use crate::scene::random::{Crop, RandomScenes, Sample};
use crate::scene::street::CAMERA_HEIGHT_M;
use crate::scene::{Options, Scene};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::path::{Path, PathBuf};

/// Purpose of the places' random numbers.
const PLACES: u64 = 0x57EE;

/// A square scene.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Rendered {
    /// Pixels across and down.
    pub(super) side: usize,
    /// The satellite image, three bytes a pixel.
    pub(super) rgb: Vec<u8>,
    /// Height of the surface, metres.
    pub(super) surface: Vec<f32>,
    /// Height of the bare earth under it, metres.
    pub(super) ground: Vec<f32>,
    /// What the surface is, by the numbers of [`crate::model::train::Class`].
    pub(super) classes: Vec<u8>,
    /// What is seen from its streets.
    pub(super) views: Vec<StreetView>,
}

/// A panorama from a street of a scene.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct StreetView {
    /// Pixel of the scene in whose middle the camera stands: column, row.
    pub(super) at: [usize; 2],
    /// The panorama, three bytes a pixel, twice as wide as high, its middle column to the north.
    pub(super) rgb: Vec<u8>,
    /// 255 where it shows the sky.
    pub(super) sky: Vec<u8>,
}

/// Which scenes: everything that their pixels depend on beside the index.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Series {
    /// Seed of the scenes.
    pub(super) seed: u64,
    /// Side, pixels.
    pub(super) side: usize,
    /// Ground size of a pixel, metres.
    pub(super) pixel_m: f64,
    /// Panoramas of each scene, at most.
    pub(super) views: usize,
    /// Columns of a panorama.
    pub(super) panorama: usize,
}

/// Makes scene `index` of a series, or says why it cannot be made.
pub(super) type Make = dyn Fn(&Series, u64) -> Result<Rendered, String> + Send + Sync;

/// Makes it of random cities.
pub(super) fn random_city(series: &Series, index: u64) -> Result<Rendered, String> {
    let Series { seed, side, .. } = *series;
    let metres = side as f64 * series.pixel_m;
    let scenes = RandomScenes { seed };
    let spec = scenes.spec_for(index, metres);
    let scene = Scene::new(spec, &Options::default()).map_err(|error| error.to_string())?;
    let sample = Sample::new(&scene, scenes.kind(index), side, &Crop::centred(metres));
    let views = match series.views {
        0 => Vec::new(),
        _ => street_views(&scene, &sample, series, index),
    };
    let Sample { rgb, surface, ground, classes, .. } = sample;
    Ok(Rendered { side, rgb, surface, ground, classes, views })
}

/// Panoramas from places in the middle of a scene where a car can stand: on its streets, or on free ground where it
/// has none.
fn street_views(scene: &Scene, sample: &Sample, series: &Series, index: u64) -> Vec<StreetView> {
    /// Places that are tried.
    const TRIES: usize = 400;
    let side = series.side;
    let pixels = PixelPositions::square(&scene.frame, side, [0.0; 2], side as f64 * series.pixel_m);
    let mut draw = Draw::new(&[series.seed, PLACES, index]);
    let (mut streets, mut free) = (Vec::new(), Vec::new());
    for _ in 0..TRIES {
        let at = [side / 4 + draw.index(side / 2), side / 4 + draw.index(side / 2)];
        let pixel = at[1] * side + at[0];
        let clear = sample.surface[pixel] - sample.ground[pixel] < 0.3;
        if sample.classes[pixel] == 0 && clear {
            let [x, y] = pixels.row(at[1])[at[0]];
            if scene.is_street(x, y) { streets.push(at) } else { free.push(at) }
        }
    }
    let places = if streets.is_empty() { free } else { streets };
    let views = places.into_iter().take(series.views).map(|at| {
        let place = pixels.row(at[1])[at[0]];
        let view = scene.panorama(place, CAMERA_HEIGHT_M, series.panorama);
        StreetView { at, rgb: view.rgb, sky: view.sky }
    });
    views.collect()
}

impl Rendered {
    /// Bytes in memory.
    pub(super) const fn bytes(series: &Series) -> usize {
        let Series { side, views, panorama, .. } = *series;
        side * side * (3 + 4 + 4 + 1) + views * panorama * panorama / 2 * 4
    }

    /// What a cache file holds.
    fn encode(&self) -> Option<Vec<u8>> {
        let (surface, ground) = (bytes_of(&self.surface), bytes_of(&self.ground));
        let shape = vec![self.side, self.side];
        let view = |dtype, shape: &[usize], data| TensorView::new(dtype, shape.to_vec(), data).ok();
        // All views in one piece each.
        let count = self.views.len();
        let bytes =
            |of: fn(&StreetView) -> &Vec<u8>| self.views.iter().flat_map(of).copied().collect();
        let (rgbs, skies): (Vec<u8>, Vec<u8>) = (bytes(|view| &view.rgb), bytes(|view| &view.sky));
        let places = self.views.iter().flat_map(|view| view.at);
        let places: Vec<u8> = places.flat_map(|at| (at as u32).to_le_bytes()).collect();
        let tensors = [
            ("classes", view(Dtype::U8, &shape, &self.classes)?),
            ("ground", view(Dtype::F32, &shape, &ground)?),
            ("places", view(Dtype::U32, &[count, 2], &places)?),
            ("rgb", view(Dtype::U8, &[self.side, self.side, 3], &self.rgb)?),
            ("surface", view(Dtype::F32, &shape, &surface)?),
            ("views", view(Dtype::U8, &[rgbs.len()], &rgbs)?),
            ("skies", view(Dtype::U8, &[skies.len()], &skies)?),
        ];
        safetensors::serialize(tensors, None).ok()
    }

    /// The scene of a cache file; `None` where it is none, or one of another size.
    fn decode(bytes: &[u8], series: &Series) -> Option<Self> {
        let side = series.side;
        let file = SafeTensors::deserialize(bytes).ok()?;
        let data = |name: &str, dtype, size: usize| {
            let tensor = file.tensor(name).ok()?;
            (tensor.dtype() == dtype && tensor.data().len() == size).then(|| tensor.data().to_vec())
        };
        let area = side * side;
        let count = *file.tensor("places").ok()?.shape().first()?;
        let size = series.panorama * (series.panorama / 2);
        let numbers = data("places", Dtype::U32, 8 * count)?;
        let numbers = numbers.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b) as usize);
        let places: Vec<usize> = numbers.collect();
        let rgbs = data("views", Dtype::U8, 3 * size * count)?;
        let skies = data("skies", Dtype::U8, size * count)?;
        let view = |i: usize| StreetView {
            at: [places[2 * i], places[2 * i + 1]],
            rgb: rgbs[3 * size * i..][..3 * size].to_vec(),
            sky: skies[size * i..][..size].to_vec(),
        };
        Some(Self {
            side,
            views: (0..count).map(view).collect(),
            rgb: data("rgb", Dtype::U8, 3 * area)?,
            surface: floats_of(&data("surface", Dtype::F32, 4 * area)?),
            ground: floats_of(&data("ground", Dtype::F32, 4 * area)?),
            classes: data("classes", Dtype::U8, area)?,
        })
    }
}

fn bytes_of(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

fn floats_of(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

/// Scenes of one series, from the cache folder where they are there.
pub(super) struct Scenes {
    series: Series,
    make: Box<Make>,
    cache: Option<PathBuf>,
}

impl Scenes {
    /// Scenes that `make` makes, kept in `cache` if there is one.
    pub(super) fn new(series: Series, make: Box<Make>, cache: Option<&Path>) -> Self {
        // A folder for each series: scenes of another program are not these.
        let cache = cache.map(|folder| {
            let Series { seed, side, pixel_m, views, panorama } = series;
            let version = env!("CARGO_PKG_VERSION");
            let street = match views {
                0 => String::new(),
                _ => format!("-{views}x{panorama}"),
            };
            folder.join(format!("scenes-{version}-seed{seed}-{side}px-{pixel_m}m{street}"))
        });
        let cache = cache.filter(|folder| match std::fs::create_dir_all(folder) {
            Ok(()) => true,
            Err(error) => {
                tracing::warn!("{}: no cache: {error}", folder.display());
                false
            }
        });
        Self { series, make, cache }
    }

    /// Scene `index`, read or made.
    pub(super) fn get(&self, index: u64) -> Result<Rendered, String> {
        let Some(folder) = &self.cache else { return (self.make)(&self.series, index) };
        let path = folder.join(format!("{index}.safetensors"));
        let known = std::fs::read(&path).ok();
        if let Some(scene) = known.and_then(|bytes| Rendered::decode(&bytes, &self.series)) {
            return Ok(scene);
        }
        let scene = (self.make)(&self.series, index)?;
        let written = scene.encode().map_or(Ok(()), |bytes| write_atomic(&path, &bytes));
        if let Err(error) = written {
            tracing::warn!("{}: not kept: {error}", path.display());
        }
        Ok(scene)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    const SERIES: Series = Series { seed: 3, side: 20, pixel_m: 0.25, views: 2, panorama: 8 };

    fn grey(series: &Series, index: u64) -> Rendered {
        let (side, area) = (series.side, series.side * series.side);
        Rendered {
            side,
            rgb: vec![index as u8; 3 * area],
            surface: (0..area).map(|i| i as f32 * 0.1).collect(),
            ground: vec![-0.5; area],
            classes: vec![2; area],
            views: vec![
                StreetView { at: [3, 4], rgb: vec![7; 96], sky: vec![255; 32] },
                StreetView { at: [13, 9], rgb: (0..96).collect(), sky: vec![0; 32] },
            ],
        }
    }

    fn counting(cache: &Path) -> (Scenes, Arc<AtomicUsize>) {
        let count = Arc::new(AtomicUsize::new(0));
        let counter = Arc::clone(&count);
        let make = move |series: &Series, index: u64| {
            counter.fetch_add(1, Ordering::Relaxed);
            Ok(grey(series, index))
        };
        (Scenes::new(SERIES, Box::new(make), Some(cache)), count)
    }

    #[test]
    fn a_cached_scene_is_the_same_and_a_damaged_one_is_made_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let (scenes, made) = counting(folder.path());
        let first = scenes.get(5);
        assert_eq!(first, Ok(grey(&SERIES, 5)));
        assert_eq!(scenes.get(5), first);
        let (scenes, again) = counting(folder.path());
        assert_eq!(scenes.get(5), first);
        assert_eq!((made.load(Ordering::Relaxed), again.load(Ordering::Relaxed)), (1, 0));
        let series = std::fs::read_dir(folder.path()).expect("lists").next().expect("one");
        let file = series.expect("a folder").path().join("5.safetensors");
        let bytes = std::fs::read(&file).expect("reads");
        std::fs::write(&file, &bytes[..bytes.len() / 2]).expect("writes");
        assert_eq!(scenes.get(5), first);
        assert_eq!(again.load(Ordering::Relaxed), 1);
        assert_eq!(std::fs::read(&file).expect("reads"), bytes);
    }
}
