//! What views mean for a plan.

use super::{FrameKind, Height, Lens, ViewRequests};
use crate::plan::Step;

impl ViewRequests {
    /// The steps that views take, on and off, with cost and cause. Pictures have no error in metres: all
    /// bounds are zero. The network's own steps (sky, super-resolution) are the run's, which knows the
    /// network: see [`Self::needs_sky`] and [`Self::needs_super_resolution`].
    #[must_use]
    pub fn steps(&self) -> Vec<Step> {
        let doubled = self.super_resolution;
        let rays = |[width, height]: [usize; 2]| format!("{width} x {height} rays");
        let (size, _) = self.optics.rays(doubled);
        let picture = rays(size);
        let [width, height] = self.optics.size;
        let lens = match self.optics.lens {
            Lens::FieldOfView { horizontal, vertical: None } => format!("{horizontal} degrees"),
            Lens::FieldOfView { horizontal, vertical: Some(vertical) } => {
                format!("{horizontal} x {vertical} degrees")
            }
            Lens::Intrinsics(_) => "given intrinsics".to_owned(),
        };
        let asked = |on: bool| if on { "asked for" } else { "not asked for" };
        let view = |id: &str, on, form: &str, cost: String, cause: &str| {
            Step::exact(id, on, form, [&cost, cause, asked(on)])
        };
        let mut steps = vec![
            view("satellite-view", self.satellite, "256 x 256", rays([256, 256]), "--satellite"),
            view(
                "panorama",
                self.panorama,
                if doubled { "512 x 128" } else { "256 x 64" },
                rays([256, 64]),
                "--panorama",
            ),
            view(
                "perspective",
                self.perspective,
                &format!("{width} x {height}, {lens}"),
                picture.clone(),
                "--perspective",
            ),
        ];
        let cameras = self.cameras.as_ref();
        let count: usize = (cameras.iter().flat_map(|file| &file.cameras))
            .map(|camera| camera.optics.rays(doubled).0)
            .map(|[width, height]| width * height)
            .sum();
        let of_cameras = cameras.map_or(0, |file| file.count);
        let form = format!("{of_cameras} pictures");
        steps.push(view("cameras", cameras.is_some(), &form, format!("{count} rays"), "--cameras"));
        if let Some(path) = &self.path {
            let frames = path.frames();
            let (what, cost) = match path.kind {
                FrameKind::Panorama => ("panoramas", rays([256, 64])),
                FrameKind::Follow => ("pictures along the path", picture),
                FrameKind::Surround { .. } => {
                    ("rows of four pictures", format!("4 times {picture}"))
                }
            };
            let form = format!("{frames} {what}");
            steps.push(view("trajectory", true, &form, format!("{cost} a frame"), "--trajectory"));
            steps.push(Step::exact(
                "animation",
                true,
                "GIF of 256 colours; MP4 where ffmpeg is installed",
                [
                    "median cut over all frames; all frames once through ffmpeg",
                    "--trajectory",
                    "colours of the GIF differ from the frames' by its palette; a missing MP4 is said",
                ],
            ));
        } else {
            steps.push(view("trajectory", false, "frames", "rays".to_owned(), "--trajectory"));
        }
        // Cameras from a file stand where it says.
        let stands = self.panorama || self.perspective || self.path.is_some();
        let looks = self.perspective
            && self.look_at.is_some_and(|place| !matches!(place, super::Place::Metres(_)));
        let probes = looks || stands && matches!(self.height, Height::AboveSurface(_));
        steps.push(view(
            "surface-probe",
            probes,
            "median of 9 rays",
            "9 rays a place".to_owned(),
            "a height above the surface, or a place to look at without a height",
        ));
        steps.push(view(
            "view-depth",
            self.depth,
            "npz and preview",
            "six densities more a ray".to_owned(),
            "--with depth",
        ));
        steps
    }

    /// What a person should know before the work: what will be missing, and why.
    #[must_use]
    pub fn notes(&self) -> Vec<String> {
        let missing = self.path.as_ref().filter(|path| path.video.is_none());
        let note = "no MP4: ffmpeg was not found (frames and GIF are written)";
        missing.map(|_| note.to_owned()).into_iter().collect()
    }
}
