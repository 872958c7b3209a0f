//! Arguments of meshes and density volumes.

use clap::ValueEnum;
use sat3d::infer::{MeshRequest, VolumeFormat, VolumeRequest};
use sat3d::mesh_file::MeshFormat;
use sat3d::model::mesh::{MeshColor, MeshFrame, MeshLattice};

/// Surfaces and volumes of the scene.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Mesh and volume")]
pub(crate) struct MeshArgs {
    /// Also write a mesh: glb, ply or obj gives <stem>.<format>; for one image also a file name in the
    /// output folder
    #[arg(long, value_name = "FORMAT|NAME", value_parser = mesh_name)]
    mesh: Option<MeshName>,
    /// What colours the mesh: the scene's own colours, the satellite image as a texture, or nothing
    #[arg(long, value_enum, default_value_t = ColorArg::Field, requires = "mesh")]
    mesh_color: ColorArg,
    /// Axes of the mesh: metres east, north and up, or the reference's cube units (south, up, west)
    #[arg(long, value_enum, default_value_t = FrameArg::EastNorthUp, requires = "mesh")]
    frame: FrameArg,
    /// Density of the mesh's surface, per unit of the cube
    #[arg(long, value_name = "DENSITY", default_value_t = 5.0, requires = "mesh", value_parser = isovalue)]
    isovalue: f32,
    /// Also write the density volume as <stem>_density.npy or <stem>_density.zarr/
    #[arg(long, value_enum, value_name = "FORMAT")]
    density: Option<DensityArg>,
    /// Where mesh and volume take densities: at the pixels' centres, or on the released grid, whose columns
    /// drift by up to one voxel
    #[arg(long, value_enum, default_value_t = LatticeArg::Pixels)]
    lattice: LatticeArg,
    /// Points of the lattice across: pixels along a side of the crop (default: 256), or of the released
    /// grid (default: 320)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=1024))]
    grid_size: Option<u32>,
}

/// A format alone, or a file's name.
#[derive(Clone, Debug, PartialEq, Eq)]
struct MeshName {
    format: MeshFormat,
    file: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum ColorArg {
    Field,
    Texture,
    None,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum FrameArg {
    EastNorthUp,
    Reference,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum DensityArg {
    Npy,
    Zarr,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum LatticeArg {
    Pixels,
    Reference,
}

impl MeshArgs {
    /// The mesh that is asked for.
    pub(crate) fn mesh(&self) -> Option<MeshRequest> {
        let MeshName { format, file } = self.mesh.clone()?;
        Some(MeshRequest {
            format,
            file,
            isovalue: self.isovalue,
            lattice: self.lattice(),
            frame: match self.frame {
                FrameArg::EastNorthUp => MeshFrame::EastNorthUp,
                FrameArg::Reference => MeshFrame::Reference,
            },
            color: match self.mesh_color {
                ColorArg::Field => MeshColor::Field,
                ColorArg::Texture => MeshColor::Texture,
                ColorArg::None => MeshColor::None,
            },
        })
    }

    /// The volume that is asked for.
    pub(crate) fn density(&self) -> Option<VolumeRequest> {
        let format = match self.density? {
            DensityArg::Npy => VolumeFormat::Npy,
            DensityArg::Zarr => VolumeFormat::Zarr,
        };
        Some(VolumeRequest { format, lattice: self.lattice() })
    }

    fn lattice(&self) -> MeshLattice {
        let points = |default: usize| self.grid_size.map_or(default, |size| size as usize);
        match self.lattice {
            LatticeArg::Pixels => MeshLattice::Pixels { size: points(256) },
            LatticeArg::Reference => MeshLattice::Reference { count: points(320) },
        }
    }

    /// Arguments that would be without effect are mistakes.
    ///
    /// # Errors
    /// A lattice without a mesh or volume.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        let lattice = self.lattice != LatticeArg::Pixels || self.grid_size.is_some();
        anyhow::ensure!(
            !lattice || self.mesh.is_some() || self.density.is_some(),
            "--lattice and --grid-size belong to --mesh and --density; add one of them"
        );
        Ok(())
    }
}

fn mesh_name(text: &str) -> Result<MeshName, String> {
    if let Ok(format) = text.parse() {
        return Ok(MeshName { format, file: None });
    }
    let Some((stem, end)) = text.rsplit_once('.') else {
        return Err("neither glb, ply or obj nor a file name that ends so".to_owned());
    };
    if text.contains(['/', '\\']) || stem.is_empty() {
        return Err("a mesh is written into the output folder: give a name without folders, and the folder with --out".to_owned());
    }
    Ok(MeshName { format: end.parse()?, file: Some(text.to_owned()) })
}

fn isovalue(text: &str) -> Result<f32, String> {
    let value = text.parse().ok().filter(|value: &f32| value.is_finite() && *value > 0.0);
    value.ok_or_else(|| "not a density above 0".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser, Debug)]
    struct Cli {
        #[command(flatten)]
        mesh: MeshArgs,
    }

    fn parse(line: &str) -> Result<MeshArgs, String> {
        let words = std::iter::once("x").chain(line.split_whitespace());
        Cli::try_parse_from(words).map(|cli| cli.mesh).map_err(|error| error.to_string())
    }

    #[test]
    fn formats_and_names() {
        let mesh = |line: &str| parse(line).expect("parses").mesh().expect("a mesh");
        let plain = mesh("--mesh glb");
        assert_eq!((plain.format, plain.file.as_deref()), (MeshFormat::Glb, None));
        assert_eq!((plain.isovalue, plain.lattice), (5.0, MeshLattice::Pixels { size: 256 }));
        let named = mesh("--mesh my.house.PLY --lattice reference --mesh-color texture");
        assert_eq!((named.format, named.stem("x")), (MeshFormat::Ply, "my.house"));
        assert_eq!(named.lattice, MeshLattice::Reference { count: 320 });
        assert_eq!(named.color, MeshColor::Texture);
        let volume = parse("--density zarr --grid-size 64").expect("parses");
        volume.check().expect("a lattice of a volume");
        assert_eq!(volume.density().expect("a volume").lattice, MeshLattice::Pixels { size: 64 });
        assert!(volume.mesh().is_none());
    }

    #[test]
    fn mistakes_are_named() {
        for (line, says) in [
            ("--mesh stl", "glb, ply or obj"),
            ("--mesh a.stl", "`stl` is no mesh format"),
            ("--mesh out/a.glb", "without folders"),
            ("--mesh .glb", "without folders"),
            ("--mesh glb --isovalue 0", "above 0"),
            ("--isovalue 3", "--mesh"),
            ("--mesh glb --grid-size 4", "8"),
        ] {
            let error = parse(line).expect_err(line);
            assert!(error.contains(says), "{line}: `{error}` does not say `{says}`");
        }
        assert!(parse("--grid-size 64").expect("parses").check().is_err());
    }
}
