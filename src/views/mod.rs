//! Views of a scene as pictures: cameras, paths, frames, animations.
//!
//! [`ViewRequests`] says what is wanted, for all images of a run alike; [`render`] makes it for one image's
//! scene and returns files as bytes. Where things are is said once in [`World`] (metres), [`Place`] (what
//! users write) and [`lens`] (pixels and rays).

mod animation;
pub mod cameras;
mod depth;
mod error;
pub mod lens;
mod pixels;
mod place;
mod shot;
mod steps;
mod trajectory;
mod world;

pub use animation::{VideoEncoder, gif};
pub use cameras::{CameraError, CameraFile};
pub use error::ViewError;
pub use lens::{Lens, Optics};
pub use pixels::{Picture, Rounding};
pub use place::{Height, Place, PlaceError, STREET_Z};
pub use trajectory::{FrameKind, Station, Trajectory, TrajectoryError};
pub use world::World;

use crate::footprint::Footprint;
use crate::model::render::{Angles, Camera, Pose, RenderOptions};
use crate::model::{Network, Scene};
use crate::plan::runs;
use place::Surroundings;
use serde::Serialize;
use shot::{Exposure, Shot};

/// Pixels along each side of the satellite view.
pub const SATELLITE_SIZE: usize = 256;

/// What is wanted. Serialised, it is what a plan's parameters say about views.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ViewRequests {
    /// The view straight down, 256 x 256.
    pub satellite: bool,
    /// All directions, 512 x 128 with super-resolution and 256 x 64 rays without.
    pub panorama: bool,
    /// A picture of a pinhole camera.
    pub perspective: bool,
    /// Size and lens of perspective pictures.
    pub optics: Optics,
    /// Where the camera stands; without a place in the middle of the crop.
    pub position: Option<Place>,
    /// How high the camera stands, of a path too.
    pub height: Height,
    /// How the camera is turned, degrees in the cube. Pitch and roll also turn the cameras of a path, and
    /// yaw is added to its direction.
    pub angles: Angles,
    /// What the perspective picture has in its middle; yaw and pitch are then found.
    pub look_at: Option<Place>,
    /// Cameras from a file.
    pub cameras: Option<CameraFile>,
    /// A path.
    pub path: Option<PathRequest>,
    /// Whether each view comes with its depth, opacity, normals and points.
    pub depth: bool,
    /// How rays are sampled and laid over the sky.
    pub options: RenderOptions,
    /// Whether the model has super-resolution (`config.super_resolution == 2`).
    pub super_resolution: bool,
}

/// A path and its frames.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PathRequest {
    /// The path.
    pub trajectory: Trajectory,
    /// What a frame shows.
    pub kind: FrameKind,
    /// Every how many rows of the path a frame is made.
    pub every: usize,
    /// Frames a second of the animations.
    pub fps: u32,
    /// What makes the MP4; `None` where there is no ffmpeg. Not part of a plan, which is the same on every
    /// machine.
    #[serde(skip)]
    pub video: Option<VideoEncoder>,
}

impl PathRequest {
    /// How many frames there are.
    #[must_use]
    pub fn frames(&self) -> usize {
        self.trajectory.count.div_ceil(self.every.max(1))
    }
}

/// The four pictures of a row, and how far each is turned from the front, degrees.
const SURROUND: [(&str, f64); 4] =
    [("left", -90.0), ("front", 0.0), ("right", 90.0), ("back", 180.0)];

/// What one image's views are made from.
#[derive(Clone, Copy)]
pub struct ViewContext<'a> {
    /// The scene, with a sky where [`ViewRequests::needs_sky`].
    pub scene: &'a Scene,
    /// The network, where [`ViewRequests::needs_super_resolution`].
    pub network: Option<&'a dyn Network>,
    /// The image's place and size.
    pub footprint: &'a Footprint,
    /// The image's name without its ending; what file names begin with.
    pub stem: &'a str,
}

/// A file to be written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NamedFile {
    /// Path below the output folder, with `/` between folders.
    pub path: String,
    /// What is in it.
    pub bytes: Vec<u8>,
}

impl ViewRequests {
    /// Whether nothing is wanted.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        !self.satellite && !self.needs_sky()
    }

    /// Whether any view may see the sky: all but the satellite view.
    #[must_use]
    pub fn needs_sky(&self) -> bool {
        self.panorama || self.perspective || self.cameras.is_some() || self.path.is_some()
    }

    /// Whether the network is needed after rendering.
    #[must_use]
    pub fn needs_super_resolution(&self) -> bool {
        self.super_resolution && self.needs_sky()
    }

    /// Paths of the files of one image, in the order in which [`render`] makes them.
    #[must_use]
    pub fn files(&self, stem: &str) -> Vec<String> {
        let mut files = Vec::new();
        let view = |files: &mut Vec<String>, name: &str| {
            let ends: &[&str] = if self.depth { &["_depth.npz", "_depth.png"] } else { &[] };
            files.extend(ends.iter().map(|end| format!("{name}{end}")));
        };
        let stills = [
            (self.satellite, "satellite"),
            (self.panorama, "panorama"),
            (self.perspective, "perspective"),
        ];
        let stills = stills.iter().filter(|(on, _)| *on).map(|(_, name)| format!("{stem}_{name}"));
        let cameras = self.cameras.iter().flat_map(|file| &file.cameras);
        for name in stills.chain(cameras.map(|camera| format!("{stem}_cameras/{}", camera.name))) {
            view(&mut files, &name);
            files.push(format!("{name}.png"));
        }
        let Some(path) = &self.path else { return files };
        for number in 1..=path.frames() {
            let name = format!("{stem}_trajectory/{number:04}");
            match path.kind {
                FrameKind::Surround { .. } => {
                    for (side, _) in SURROUND {
                        view(&mut files, &format!("{name}_{side}"));
                    }
                }
                FrameKind::Panorama | FrameKind::Follow => view(&mut files, &name),
            }
            files.push(format!("{name}.png"));
        }
        files.push(format!("{stem}_trajectory.gif"));
        files.extend(path.video.iter().map(|_| format!("{stem}_trajectory.mp4")));
        files
    }

    /// Checks what can be checked without an image.
    ///
    /// # Errors
    /// Sizes and angles that are not rendered.
    pub fn check(&self) -> Result<(), ViewError> {
        self.optics.check()
    }
}

/// All files of one image's views.
///
/// # Errors
/// [`ViewError`] for places outside the image and failures of the network or an encoder.
pub fn render(
    requests: &ViewRequests,
    context: &ViewContext<'_>,
) -> Result<Vec<NamedFile>, ViewError> {
    let mut files = Vec::new();
    render_each(requests, context, &mut |file| {
        files.push(file);
        Ok(())
    })?;
    Ok(files)
}

/// As [`render`], but hands on each file as soon as it is made, so that many large ones need not be in memory
/// at once.
///
/// # Errors
/// As [`render`]; [`ViewError::Write`] for what `write` refuses.
pub fn render_each(
    requests: &ViewRequests,
    context: &ViewContext<'_>,
    write: &mut dyn FnMut(NamedFile) -> std::io::Result<()>,
) -> Result<(), ViewError> {
    if requests.needs_super_resolution() && context.network.is_none() {
        return Err(ViewError::NoNetwork);
    }
    if requests.needs_sky() && context.scene.parts().sky.is_none() {
        return Err(ViewError::NoSky);
    }
    requests.check()?;
    let ViewContext { scene, network, footprint, stem } = *context;
    let world = World::new(scene, footprint);
    let around = Surroundings { scene, footprint, world };
    let network = network.filter(|_| requests.super_resolution);
    let mut exposure = Exposure { scene, network, world, requests, write };
    if requests.satellite {
        runs("satellite-view");
        exposure.save(&Shot::satellite(format!("{stem}_satellite")))?;
    }
    if requests.panorama || requests.perspective {
        let position = around.camera(requests.position, requests.height)?;
        if requests.panorama {
            runs("panorama");
            exposure.save(&Shot::panorama(format!("{stem}_panorama"), position))?;
        }
        if requests.perspective {
            runs("perspective");
            let angles = aim(requests, &around, position)?;
            let pose = Pose { position, rotation: angles.rotation() };
            let name = format!("{stem}_perspective");
            exposure.save(&Shot::perspective(name, &requests.optics, pose, requests))?;
        }
    }
    for camera in requests.cameras.iter().flat_map(|file| &file.cameras) {
        let pose = Pose {
            position: world.to_cube(camera.position),
            rotation: world.camera_to_cube(&camera.rotation),
        };
        let name = format!("{stem}_cameras/{}", camera.name);
        runs("cameras");
        exposure.save(&Shot::perspective(name, &camera.optics, pose, requests))?;
    }
    match &requests.path {
        Some(path) => film(path, &around, stem, &mut exposure),
        None => Ok(()),
    }
}

/// How the perspective picture's camera is turned.
fn aim(
    requests: &ViewRequests,
    around: &Surroundings<'_>,
    eye: [f64; 3],
) -> Result<Angles, ViewError> {
    let Some(place) = requests.look_at else { return Ok(requests.angles) };
    let target = around.target(place)?;
    let [east, north, up] = [0, 1, 2].map(|axis| target[axis] - eye[axis]);
    let level = libm::hypot(east, north);
    if libm::hypot(level, up) < 1e-9 {
        return Err(ViewError::SamePlace { target: place });
    }
    Ok(Angles {
        roll: requests.angles.roll,
        pitch: -libm::atan2(up, level).to_degrees(),
        yaw: libm::atan2(east, north).to_degrees(),
    })
}

/// The frames of a path, then the animations.
fn film(
    path: &PathRequest,
    around: &Surroundings<'_>,
    stem: &str,
    exposure: &mut Exposure<'_>,
) -> Result<(), ViewError> {
    let requests = exposure.requests;
    let folder = format!("{stem}_trajectory");
    let mut frames = Vec::new();
    runs("trajectory");
    for station in path.trajectory.stations.iter().step_by(path.every.max(1)) {
        let at = Place::Pixel(station.pixel);
        let position = around.camera(Some(at), requests.height)?;
        let heading = station.yaw_deg.filter(|_| path.kind.follows()).unwrap_or_default();
        let name = format!("{folder}/{:04}", frames.len() + 1);
        let turned = |name: String, yaw: f64| {
            let angles = Angles { yaw: heading + requests.angles.yaw + yaw, ..requests.angles };
            let pose = Pose { position, rotation: angles.rotation() };
            Shot::perspective(name, &requests.optics, pose, requests)
        };
        let picture = match path.kind {
            FrameKind::Panorama => exposure.expose(&Shot::panorama(name.clone(), position))?,
            FrameKind::Follow => exposure.expose(&turned(name.clone(), 0.0))?,
            FrameKind::Surround { mirrored, .. } => {
                let mut row = Vec::with_capacity(4);
                for (side, yaw) in SURROUND {
                    let picture = exposure.expose(&turned(format!("{name}_{side}"), yaw))?;
                    let mirror = mirrored && side == "back";
                    row.push(if mirror { picture.mirrored() } else { picture });
                }
                Picture::row(&row)
            }
        };
        exposure.write(format!("{name}.png"), picture.png()?)?;
        frames.push(picture);
    }
    runs("animation");
    exposure.write(format!("{folder}.gif"), gif(&frames, path.fps)?)?;
    match &path.video {
        Some(encoder) => {
            exposure.write(format!("{folder}.mp4"), encoder.encode(&frames, path.fps)?)
        }
        None => Ok(()),
    }
}

/// The released panorama's rays.
fn panorama_camera(position: [f64; 3]) -> Camera {
    Camera::Panorama { width: 256, height: 64, position }
}
