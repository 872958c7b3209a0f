//! Arguments of views: pictures from above and from the street, and the light they are in.

use anyhow::{Context, bail, ensure};
use clap::ValueEnum;
use sat3d::illumination::Illumination;
use sat3d::model::render::{Angles, Composite, Intrinsics, RenderOptions, SkySeam};
use sat3d::views::{
    CameraFile, FrameKind, Height, Lens, Optics, PathRequest, Place, Trajectory, VideoEncoder,
    ViewRequests,
};
use std::path::PathBuf;

/// Views of the scene.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Views")]
pub(crate) struct ViewArgs {
    /// Also write <stem>_satellite.png: the view straight down, 256 x 256
    #[arg(long)]
    satellite: bool,
    /// Also write <stem>_panorama.png: all directions, north in the middle, 512 x 128
    #[arg(long)]
    panorama: bool,
    /// Also write <stem>_perspective.png: the picture of a pinhole camera
    #[arg(long)]
    perspective: bool,
    /// Where the camera stands: px:COLUMN,ROW of the image, LATITUDE,LONGITUDE, or EAST,NORTH,UP in
    /// metres from the middle of the crop and the bottom of the scene (default: the middle)
    #[arg(long, value_name = "PLACE", allow_hyphen_values = true)]
    position: Option<Place>,
    /// Metres above the surface at that place (default: the height of the training's street cameras)
    #[arg(long, value_name = "M", value_parser = metres)]
    height: Option<f64>,
    /// Direction in degrees: 0 north, 90 east
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_negative_numbers = true)]
    yaw: f64,
    /// Degrees down from level
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_negative_numbers = true)]
    pitch: f64,
    /// Degrees about the viewing direction
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_negative_numbers = true)]
    roll: f64,
    /// What the perspective picture has in its middle, written as --position; without metres the surface
    /// at that place
    #[arg(long, value_name = "PLACE", allow_hyphen_values = true, requires = "perspective", conflicts_with_all = ["yaw", "pitch"])]
    look_at: Option<Place>,
    /// Field of view across and down, degrees (default: 120, square pixels)
    #[arg(long, value_name = "H[,V]", value_parser = field_of_view)]
    fov: Option<Lens>,
    /// Focal lengths and principal point in pixels of the picture, whose upper left corner is 0,0
    #[arg(long, value_name = "FX,FY,CX,CY", value_parser = intrinsics, conflicts_with = "fov")]
    intrinsics: Option<Lens>,
    /// Pixels of perspective pictures (default: 256x256, of --cameras the file's)
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<[u32; 2]>,
    /// Also write a picture of each camera of a file into <stem>_cameras/: a NeRF transforms.json, or the
    /// folder of a COLMAP model; the world is east, north and up in metres
    #[arg(long, value_name = "FILE|DIR")]
    cameras: Option<PathBuf>,
    /// Also write the frames of a path into <stem>_trajectory/, and a GIF (with ffmpeg an MP4): a CSV of
    /// columns w, h (pixels of the image) and angle; without --follow and --surround they are panoramas
    #[arg(long, value_name = "CSV")]
    trajectory: Option<PathBuf>,
    /// Frames look along the path
    #[arg(long, requires = "trajectory")]
    follow: bool,
    /// Frames are four pictures: left, front, right, back (mirrored)
    #[arg(long, requires = "trajectory")]
    surround: bool,
    /// The picture to the back is not mirrored
    #[arg(long, requires = "surround")]
    unmirrored: bool,
    /// A frame for every so many rows of the path
    #[arg(long, value_name = "N", default_value_t = 1, requires = "trajectory", value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Frames a second
    #[arg(long, value_name = "N", default_value_t = 5, requires = "trajectory", value_parser = clap::value_parser!(u32).range(1..=50))]
    fps: u32,
    /// Beside each view: depth, opacity, normals and points as npz, and a picture of the depth
    #[arg(long, value_enum, value_name = "WHAT")]
    with: Option<With>,
    /// Light of street views: a panorama (with --sky-mask), a histogram (FILE.npy, FILE.npy:ROW), or a
    /// bundled sky: clear (default), overcast, white
    #[arg(long, value_name = "FILE|NAME")]
    illumination: Option<String>,
    /// Picture of the panorama's sky, in white
    #[arg(long, value_name = "FILE", requires = "illumination")]
    sky_mask: Option<PathBuf>,
    /// How the scene is laid over the sky: with opacity squared as trained, or once
    #[arg(long, value_enum, default_value_t = CompositeArg::Squared)]
    composite: CompositeArg,
    /// The sky's seam in the west: as trained, or closed
    #[arg(long, value_enum, default_value_t = SkySeamArg::Raw)]
    sky_seam: SkySeamArg,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum With {
    Depth,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum CompositeArg {
    Squared,
    Once,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum SkySeamArg {
    Raw,
    Wrap,
}

impl ViewArgs {
    /// Reads the files of cameras and paths and resolves what is wanted. `base` holds quadrature and
    /// depth; `super_resolution` is whether the model has it.
    ///
    /// # Errors
    /// Arguments without a view that they belong to; files and values that are no good.
    pub(crate) fn requests(
        &self,
        base: RenderOptions,
        super_resolution: bool,
    ) -> anyhow::Result<ViewRequests> {
        self.check()?;
        let optics = Optics {
            size: self.size.unwrap_or(Optics::default().size),
            lens: self.fov.or(self.intrinsics).unwrap_or_default(),
        };
        let cameras = self.cameras.as_ref().map(|path| CameraFile::read(path, self.size));
        let requests = ViewRequests {
            satellite: self.satellite,
            panorama: self.panorama,
            perspective: self.perspective,
            optics,
            position: self.position,
            height: self.height.map_or(Height::Street, Height::AboveSurface),
            angles: Angles { roll: self.roll, pitch: self.pitch, yaw: self.yaw },
            look_at: self.look_at,
            cameras: cameras.transpose().context("--cameras")?,
            path: self.path().context("--trajectory")?,
            depth: self.with == Some(With::Depth),
            options: RenderOptions {
                composite: match self.composite {
                    CompositeArg::Squared => Composite::Squared,
                    CompositeArg::Once => Composite::Once,
                },
                sky_seam: match self.sky_seam {
                    SkySeamArg::Raw => SkySeam::Raw,
                    SkySeamArg::Wrap => SkySeam::Wrap,
                },
                ..base
            },
            super_resolution,
        };
        requests.check()?;
        Ok(requests)
    }

    /// The light of street views, where one is named; there is a default for those that ask for none.
    ///
    /// # Errors
    /// Files that are no light, names that are not known.
    pub(crate) fn illumination(
        &self,
        requests: &ViewRequests,
    ) -> anyhow::Result<Option<Illumination>> {
        let Some(argument) = self.illumination.as_deref() else { return Ok(None) };
        ensure!(requests.needs_sky(), "--illumination {argument} lights street views");
        Ok(Some(Illumination::parse(Some(argument), self.sky_mask.as_deref())?))
    }

    fn path(&self) -> anyhow::Result<Option<PathRequest>> {
        let Some(path) = &self.trajectory else { return Ok(None) };
        let kind = match (self.surround, self.follow) {
            (true, follow) => FrameKind::Surround { follow, mirrored: !self.unmirrored },
            (false, true) => FrameKind::Follow,
            (false, false) => FrameKind::Panorama,
        };
        Ok(Some(PathRequest {
            trajectory: Trajectory::read(path, kind.follows())?,
            kind,
            every: self.every as usize,
            fps: self.fps,
            video: VideoEncoder::find().inspect_err(|why| tracing::debug!("no MP4: {why}")).ok(),
        }))
    }

    /// Arguments that would be without effect are mistakes.
    fn check(&self) -> anyhow::Result<()> {
        let angles = [("--yaw", self.yaw), ("--pitch", self.pitch), ("--roll", self.roll)];
        for (name, degrees) in angles {
            ensure!(degrees.is_finite(), "{name} {degrees}: not an angle in degrees");
        }
        let film = self.follow || self.surround;
        let turned = angles.iter().find(|(_, degrees)| *degrees != 0.0).map(|(name, _)| *name);
        let optics = [("--fov", self.fov), ("--intrinsics", self.intrinsics)];
        let lens = optics.iter().find(|(_, lens)| lens.is_some()).map(|(name, _)| *name);
        for name in [turned, lens].into_iter().flatten() {
            ensure!(
                self.perspective || film,
                "{name} turns or opens a perspective camera; add --perspective (or --trajectory with --follow or --surround)"
            );
        }
        ensure!(
            self.size.is_none() || self.perspective || film || self.cameras.is_some(),
            "--size is that of perspective pictures; add --perspective, --cameras, or --trajectory with --follow or --surround"
        );
        let single = self.panorama || self.perspective;
        if let Some(place) = self.position {
            ensure!(
                single,
                "--position {place} is where a camera stands; add --panorama or --perspective"
            );
        }
        if let Some(metres) = self.height
            && !(single || self.trajectory.is_some())
        {
            bail!(
                "--height {metres} is that of a camera; add --panorama, --perspective or --trajectory"
            );
        }
        let street = single || self.cameras.is_some() || self.trajectory.is_some();
        if let Some(light) = self.illumination.as_ref().filter(|_| !street) {
            bail!(
                "--illumination {light} lights street views; add --panorama, --perspective, --cameras or --trajectory"
            );
        }
        ensure!(
            self.with.is_none() || street || self.satellite,
            "--with belongs to views; add --satellite, --panorama, --perspective, --cameras or --trajectory"
        );
        Ok(())
    }
}

fn metres(text: &str) -> Result<f64, String> {
    let metres = text.parse().ok().filter(|v: &f64| *v > 0.0 && *v <= 10_000.0);
    metres.ok_or_else(|| "not a number of metres above 0, up to 10000".to_owned())
}

/// `count` numbers, separated by commas.
fn numbers(text: &str) -> Result<Vec<f64>, String> {
    text.split(',')
        .map(|word| {
            let number = word.trim().parse().ok().filter(|v: &f64| v.is_finite());
            number.ok_or_else(|| format!("`{word}` is no number"))
        })
        .collect()
}

fn field_of_view(text: &str) -> Result<Lens, String> {
    let lens = match numbers(text)?[..] {
        [horizontal] => Lens::FieldOfView { horizontal, vertical: None },
        [horizontal, vertical] => Lens::FieldOfView { horizontal, vertical: Some(vertical) },
        _ => return Err("one or two angles in degrees: H or H,V".to_owned()),
    };
    usable(lens)
}

fn intrinsics(text: &str) -> Result<Lens, String> {
    match numbers(text)?[..] {
        [fx, fy, cx, cy] => usable(Lens::Intrinsics(Intrinsics { fx, fy, cx, cy })),
        _ => Err("four numbers of pixels: FX,FY,CX,CY".to_owned()),
    }
}

fn usable(lens: Lens) -> Result<Lens, String> {
    let optics = Optics { lens, ..Optics::default() };
    optics.check().map(|()| lens).map_err(|error| error.to_string())
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let sides = text
        .split_once(['x', 'X'])
        .and_then(|(w, h)| Some([w.trim().parse().ok()?, h.trim().parse().ok()?]));
    let size = sides.ok_or_else(|| "not WIDTHxHEIGHT, as in 256x256".to_owned())?;
    let optics = Optics { size, ..Optics::default() };
    optics.check().map(|()| size).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser, Debug)]
    struct Cli {
        #[command(flatten)]
        views: ViewArgs,
    }

    fn requests(line: &str) -> Result<ViewRequests, String> {
        let words = std::iter::once("x").chain(line.split_whitespace());
        let cli = Cli::try_parse_from(words).map_err(|error| error.to_string())?;
        cli.views.requests(RenderOptions::default(), true).map_err(|error| format!("{error:#}"))
    }

    #[test]
    fn nothing_asked_for_is_nothing_wanted() {
        let none = requests("").expect("requests");
        assert!(none.is_empty());
        assert_eq!(none, ViewRequests { super_resolution: true, ..ViewRequests::default() });
    }

    #[test]
    fn arguments_become_requests() {
        let got = requests(
            "--perspective --yaw -35.5 --pitch 10 --fov 90,60 --size 320x200 --position -1.5,2,30 --with depth --composite once --sky-seam wrap",
        )
        .expect("requests");
        assert_eq!(got.optics.size, [320, 200]);
        assert_eq!(got.optics.lens, Lens::FieldOfView { horizontal: 90.0, vertical: Some(60.0) });
        assert_eq!(got.angles, Angles { roll: 0.0, pitch: 10.0, yaw: -35.5 });
        assert_eq!(got.position, Some(Place::Metres([-1.5, 2.0, 30.0])));
        assert_eq!((got.options.composite, got.options.sky_seam), (Composite::Once, SkySeam::Wrap));
        assert!(got.depth && !got.is_empty() && got.needs_super_resolution());
        let got = requests("--panorama --height 1.7 --position 320,200").expect("requests");
        assert_eq!(got.height, Height::AboveSurface(1.7));
        let got = requests("--perspective --look-at px:3,4 --roll 5 --intrinsics 90,90,128,128");
        let got = got.expect("requests");
        assert_eq!((got.look_at, got.angles.roll), (Some(Place::Pixel([3.0, 4.0])), 5.0));
    }

    #[test]
    fn mistakes_are_named() {
        for (line, says) in [
            ("--yaw 5", "--yaw turns or opens"),
            ("--panorama --fov 90", "--fov turns or opens"),
            ("--panorama --size 64x64", "--size is that of perspective"),
            ("--satellite --position 3,4", "--position px:3,4"),
            ("--satellite --height 2", "--height 2"),
            ("--satellite --illumination white", "--illumination white"),
            ("--with depth", "--with belongs"),
            ("--perspective --position 3.5,400.5", "px:3.5,400.5"),
            ("--perspective --look-at 3,4 --yaw 3", "cannot be used with"),
            ("--panorama --look-at 3,4", "--perspective"),
            ("--perspective --fov 180", "180 degrees"),
            ("--perspective --fov 1,2,3", "H or H,V"),
            ("--perspective --intrinsics 1,2,3", "FX,FY,CX,CY"),
            ("--perspective --intrinsics 0,2,3,4", "focal lengths are positive"),
            ("--perspective --fov 90 --intrinsics 1,2,3,4", "cannot be used with"),
            ("--perspective --size 2x2", "2x2"),
            ("--perspective --size 64", "WIDTHxHEIGHT"),
            ("--panorama --height 0", "above 0"),
            ("--perspective --yaw nan", "--yaw NaN"),
            ("--follow", "--trajectory"),
            ("--trajectory /no/such.csv --unmirrored", "--surround"),
            ("--trajectory /no/such.csv", "/no/such.csv"),
            ("--trajectory /no/such.csv --fps 51", "51"),
            ("--cameras /no/such.json", "/no/such.json"),
            ("--panorama --sky-mask m.png", "--illumination"),
        ] {
            let error = requests(line).expect_err(line);
            assert!(error.contains(says), "{line}: `{error}` does not say `{says}`");
        }
    }

    #[test]
    fn light_is_what_was_named() {
        let light = |line: &str| {
            let words = std::iter::once("x").chain(line.split_whitespace());
            let views = Cli::try_parse_from(words).expect("arguments").views;
            let requests = views.requests(RenderOptions::default(), true).expect("requests");
            views.illumination(&requests)
        };
        assert!(light("--panorama").expect("light").is_none(), "the library has a default");
        let white = light("--panorama --illumination white").expect("light").expect("light");
        assert_eq!(white.origin, "bundled sky white");
        let error = light("--panorama --illumination dusk").expect_err("no such sky");
        assert!(error.to_string().contains("overcast"), "{error}");
    }
}
