//! One picture: rays, super-resolution, bytes.

use super::pixels::{Picture, Rounding};
use super::{
    NamedFile, Optics, SATELLITE_SIZE, ViewError, ViewRequests, World, depth, panorama_camera,
};
use crate::model::render::{Camera, Pose, Wanted};
use crate::model::{Grid, Network, Scene};
use crate::plan::runs;

/// A picture to be made.
pub(super) struct Shot {
    /// Its path without the ending.
    name: String,
    camera: Camera,
    /// Columns and rows of the picture; at most as many as there are.
    size: [usize; 2],
    street: bool,
}

impl Shot {
    pub fn satellite(name: String) -> Self {
        let size = SATELLITE_SIZE;
        Self { name, camera: Camera::Ortho { size }, size: [size, size], street: false }
    }

    pub fn panorama(name: String, position: [f64; 3]) -> Self {
        let whole = [usize::MAX; 2];
        Self { name, camera: panorama_camera(position), size: whole, street: true }
    }

    pub fn perspective(name: String, optics: &Optics, pose: Pose, requests: &ViewRequests) -> Self {
        let ([width, height], intrinsics) = optics.rays(requests.super_resolution);
        let camera = Camera::Perspective { width, height, intrinsics, pose };
        Self { name, camera, size: optics.size.map(|side| side as usize), street: true }
    }
}

/// Makes pictures and hands them on.
pub(super) struct Exposure<'a> {
    pub scene: &'a Scene,
    pub network: Option<&'a dyn Network>,
    pub world: World,
    pub requests: &'a ViewRequests,
    pub write: &'a mut dyn FnMut(NamedFile) -> std::io::Result<()>,
}

impl Exposure<'_> {
    /// Hands on a file.
    pub fn write(&mut self, path: String, bytes: Vec<u8>) -> Result<(), ViewError> {
        let name = path.clone();
        (self.write)(NamedFile { path, bytes })
            .map_err(|source| ViewError::Write { path: name, source })
    }

    /// Makes a picture and hands it on.
    pub fn save(&mut self, shot: &Shot) -> Result<(), ViewError> {
        let picture = self.expose(shot)?;
        self.write(format!("{}.png", shot.name), picture.png()?)
    }

    /// Makes a picture; what belongs to it beside colour is handed on.
    pub fn expose(&mut self, shot: &Shot) -> Result<Picture, ViewError> {
        let options = &self.requests.options;
        let wanted = Wanted { color: true, normals: self.requests.depth };
        runs("colour");
        runs("rays");
        let mut view = self.scene.render(&shot.camera, options, wanted);
        if self.requests.depth {
            runs("view-depth");
            runs("depth");
            let npz = depth::npz(&self.world, &shot.camera, options, &view);
            self.write(format!("{}_depth.npz", shot.name), npz)?;
            self.write(format!("{}_depth.png", shot.name), depth::preview(&view)?)?;
        }
        // The satellite view is trained without a sky.
        let none =
            || Grid::new(3, view.height, view.width, vec![0.0; 3 * view.height * view.width]);
        let colours = view.composite.take().or_else(|| view.feature.take()).unwrap_or_else(none);
        let (colours, rounding) = match (shot.street, self.network) {
            (false, _) => (colours, Rounding::Nearest),
            (true, None) => (colours, Rounding::Down),
            // The whole frame at once: every pixel depends on all others.
            (true, Some(network)) => {
                runs("super-resolution");
                (network.super_resolve(&colours)?, Rounding::Down)
            }
        };
        let size = [shot.size[0].min(colours.width), shot.size[1].min(colours.height)];
        Ok(Picture::from_colours(&colours, rounding, size))
    }
}
