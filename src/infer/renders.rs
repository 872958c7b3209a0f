//! What is made of a scene beside its heights: mesh, density volume, views, the scene itself.

use super::item::Workshop;
use super::options::{DENSITY_END, MeshRequest, VolumeFormat, VolumeRequest};
use super::outputs::NamedBytes;
use super::record::Record;
use crate::batch::OutputFile;
use crate::footprint::Footprint;
use crate::grid::LonLat;
use crate::mesh_file::{self, MeshGeoreference};
use crate::model::mesh::{MeshColor, MeshLattice, MeshOptions};
use crate::model::render::{Border, DensityGrid, Lattice, ReferenceGrid, exact_scale};
use crate::model::{Image8, Scene};
use crate::plan::runs;
use crate::views::{self, ViewContext};
use crate::volume::{self, Axes, Frame, VolumeDescription, VolumeError, ZarrVolume};
use std::io::ErrorKind;
use std::path::Path;

/// One image's scene, with what its outputs need to know.
pub struct Subject<'a> {
    pub scene: &'a Scene,
    /// The image itself; absent where the input was a scene.
    pub image: Option<&'a Image8>,
    pub footprint: &'a Footprint,
    /// Metres of height per cube unit.
    pub unit_m: f64,
    pub stem: &'a str,
}

impl Subject<'_> {
    fn scale(&self) -> f64 {
        exact_scale(self.scene.field().scale())
    }

    /// Ground metres per cube unit, across and down.
    fn across_m(&self) -> [f64; 2] {
        self.footprint.metres_per_unit(self.scale())
    }

    /// Where the image's centre lies, if that is known.
    fn center(&self) -> Result<Option<LonLat>, String> {
        let on_earth = self.footprint.georeference().map_err(|error| error.to_string())?;
        on_earth.map(|place| place.center().map_err(|error| error.to_string())).transpose()
    }

    fn densities(&self, lattice: MeshLattice) -> DensityGrid {
        match lattice {
            MeshLattice::Pixels { size } => {
                self.scene.density_grid(Lattice::pixels(size, self.scene.field().scale()))
            }
            MeshLattice::Reference { count } => {
                self.scene.reference_grid(&ReferenceGrid { count, border: Border::Cut })
            }
        }
    }
}

impl Workshop<'_> {
    /// One call per output. Files go into `files`, but for a Zarr volume, which is a folder: it is
    /// written at once, and its files are only recorded.
    pub fn renders(
        &self,
        subject: &Subject<'_>,
        record: &mut Record,
        files: &mut Vec<NamedBytes>,
    ) -> Result<(), String> {
        let outputs = &self.options.outputs;
        if outputs.scene {
            runs("scene");
            files.extend(self.scene(
                subject.scene,
                subject.footprint,
                subject.stem,
                record.light.as_deref(),
            )?);
        }
        if let Some(request) = &outputs.mesh {
            files.extend(mesh(request, subject)?);
        }
        if !outputs.views.is_empty() {
            let context = ViewContext {
                scene: subject.scene,
                network: self.model.map(|model| model.network.as_ref()),
                footprint: subject.footprint,
                stem: subject.stem,
            };
            let pictures = views::render(&outputs.views, &context).map_err(|e| e.to_string())?;
            files.extend(pictures.into_iter().map(|file| (file.path, file.bytes)));
        }
        if outputs.density.is_some() {
            runs("density");
        }
        match outputs.density {
            Some(VolumeRequest { format: VolumeFormat::Npy, lattice }) => {
                let grid = subject.densities(lattice);
                let axes = axes(&grid, subject)?.0;
                let stem = format!("{}{DENSITY_END}", subject.stem);
                files.push((format!("{stem}.npy"), volume::npy(&grid)));
                let coordinates = volume::coordinates_npz(&axes);
                files.push((format!("{stem}_coordinates.npz"), coordinates));
            }
            Some(VolumeRequest { format: VolumeFormat::Zarr, lattice }) => {
                record.outputs.extend(self.zarr(subject, lattice)?);
            }
            None => {}
        }
        Ok(())
    }

    fn zarr(&self, subject: &Subject<'_>, lattice: MeshLattice) -> Result<Vec<OutputFile>, String> {
        let grid = subject.densities(lattice);
        let (axes, frame) = axes(&grid, subject)?;
        let [x, y] = subject.across_m();
        let mut description = VolumeDescription::new(axes, frame, [x, y, subject.unit_m]);
        let software = format!("sat3d {}", env!("CARGO_PKG_VERSION"));
        description.attributes.insert("software".into(), software.into());
        if let Some(identity) = self.identity {
            let hash = identity.sampled_sha256.clone();
            description.attributes.insert("weights_sampled_sha256".into(), hash.into());
        }
        let name = format!("{}{DENSITY_END}.zarr", subject.stem);
        let target = self.options.out.join(&name);
        let written = || {
            let mut volume = ZarrVolume::create(&target, description)?;
            volume.write_region([0; 3], grid.shape(), &grid.values)?;
            volume.finish()
        };
        written().map_err(|error| {
            if matches!(&error, VolumeError::Io { source, .. } if source.kind() == ErrorKind::StorageFull)
            {
                self.disk_full.request();
            }
            // Manifests name no folders of this machine.
            error.to_string().replace(&format!("{}/", self.options.out.display()), "")
        })?;
        let mut files = Vec::new();
        recorded(&target, &name, &mut files)
            .map_err(|error| format!("{}: {error}", target.display()))?;
        files.sort_unstable_by(|a, b| a.file.cmp(&b.file));
        Ok(files)
    }
}

impl Workshop<'_> {
    /// Removes the volume of an image that failed after it was written.
    pub fn remove_volume(&self, stem: &str) {
        if matches!(self.options.outputs.density, Some(request) if request.format == VolumeFormat::Zarr)
        {
            let target = self.options.out.join(format!("{stem}{DENSITY_END}.zarr"));
            if let Err(error) = std::fs::remove_dir_all(&target)
                && error.kind() != ErrorKind::NotFound
            {
                tracing::warn!("cannot remove {}: {error}", target.display());
            }
        }
    }
}

/// All files below a folder, with their sizes and hashes.
fn recorded(folder: &Path, name: &str, files: &mut Vec<OutputFile>) -> std::io::Result<()> {
    for item in std::fs::read_dir(folder)? {
        let path = item?.path();
        let below = format!("{name}/{}", path.file_name().unwrap_or_default().to_string_lossy());
        if path.is_dir() {
            recorded(&path, &below, files)?;
        } else {
            files.push(OutputFile::of(&below, &std::fs::read(&path)?));
        }
    }
    Ok(())
}

/// Coordinates of a volume: on the map where the image's place is known, else metres about its centre.
fn axes(grid: &DensityGrid, subject: &Subject<'_>) -> Result<(Axes, Frame), String> {
    let (footprint, unit_m) = (subject.footprint, subject.unit_m);
    let on_map = Axes::on_map(&grid.lattice, footprint, subject.scale(), unit_m);
    Ok(match (on_map, footprint.ground_grid([1, 1])) {
        (Some(axes), Some(ground)) if ground.crs.epsg.is_some() || ground.crs.wkt.is_some() => {
            (axes, Frame::Map(ground.crs))
        }
        _ => {
            let [x, y] = subject.across_m();
            let frame = Frame::Local { origin: subject.center()? };
            (Axes::local(&grid.lattice, [x, y, unit_m]), frame)
        }
    })
}

fn mesh(request: &MeshRequest, subject: &Subject<'_>) -> Result<Vec<NamedBytes>, String> {
    runs("mesh");
    if request.color == MeshColor::Field {
        runs("colour");
    }
    let across_m = subject.across_m();
    let options = MeshOptions {
        isovalue: request.isovalue,
        lattice: request.lattice,
        frame: request.frame,
        color: request.color,
        horizontal_metres_per_unit: across_m,
        vertical_metres_per_unit: subject.unit_m,
    };
    let mesh = subject.scene.mesh(&options).map_err(|error| error.to_string())?;
    let georeference = subject.center()?.map(|origin| MeshGeoreference {
        origin,
        vertical_exaggeration: subject.unit_m / (across_m[0] * across_m[1]).sqrt(),
    });
    let stem = request.stem(subject.stem);
    let files =
        mesh_file::encode(&mesh, request.format, stem, georeference.as_ref(), subject.image)
            .map_err(|error| error.to_string())?;
    Ok(files.into_iter().map(|file| (file.name, file.bytes)).collect())
}
