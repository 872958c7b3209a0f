//! Crops, symmetries of the square, and colour changes.

use crate::random::Draw;
use crate::train::settings::Symmetries;

/// One of the eight symmetries of the square: where each target pixel comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Symmetry(u8);

impl Symmetry {
    /// All of them; the first leaves everything where it is.
    #[cfg(test)]
    pub(super) const ALL: [Self; 8] =
        [Self(0), Self(1), Self(2), Self(3), Self(4), Self(5), Self(6), Self(7)];
    /// The identity.
    pub(super) const NONE: Self = Self(0);

    /// Any of those served. All choices take one draw.
    pub(super) fn draw(served: Symmetries, draw: &mut Draw) -> Self {
        let any = draw.index(8) as u8;
        Self(match served {
            Symmetries::None => 0,
            Symmetries::Mirror => any & 1,
            Symmetries::Square => any,
        })
    }

    /// The source column and row of a target pixel, in a square of `side` pixels.
    pub(super) const fn source(self, x: usize, y: usize, side: usize) -> (usize, usize) {
        let last = side - 1;
        let (x, y) = if self.0 & 1 > 0 { (last - x, y) } else { (x, y) };
        let (x, y) = if self.0 & 2 > 0 { (x, last - y) } else { (x, y) };
        if self.0 & 4 > 0 { (y, x) } else { (x, y) }
    }

    /// Where a point of the source comes to lie: offsets from the middle, right and down.
    pub(super) fn moved(self, [right, down]: [f64; 2]) -> [f64; 2] {
        let [x, y] = if self.0 & 4 > 0 { [down, right] } else { [right, down] };
        [if self.0 & 1 > 0 { -x } else { x }, if self.0 & 2 > 0 { -y } else { y }]
    }

    /// The column of a panorama (whose middle looks north) that a column of the turned one shows. `width` is a
    /// multiple of four.
    pub(super) const fn panorama_column(self, column: usize, width: usize) -> usize {
        // The source's quarter that the target's north shows, and that its east shows.
        let north = self.quarter(0, -1);
        let mirrored = self.quarter(1, 0) != (north + 1) % 4;
        let from = if mirrored { width - 1 - column } else { column };
        (from + north * (width / 4)) % width
    }

    /// The quarter (0 north, 1 east) of the source that a direction of the target shows.
    const fn quarter(self, right: i8, down: i8) -> usize {
        let right = if self.0 & 1 > 0 { -right } else { right };
        let down = if self.0 & 2 > 0 { -down } else { down };
        let (right, down) = if self.0 & 4 > 0 { (down, right) } else { (right, down) };
        match (right, down) {
            (0, -1) => 0,
            (1, 0) => 1,
            (0, 1) => 2,
            _ => 3,
        }
    }
}

/// A square window in a larger square, and how it is turned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Crop {
    /// First column in the larger square.
    pub(super) x: usize,
    /// First row.
    pub(super) y: usize,
    /// Side, pixels.
    pub(super) side: usize,
    /// Side of the larger square.
    pub(super) whole: usize,
    /// How the window is turned.
    pub(super) symmetry: Symmetry,
}

impl Crop {
    /// In the middle, not turned.
    pub(super) const fn centre(whole: usize, side: usize) -> Self {
        let margin = (whole - side) / 2;
        Self { x: margin, y: margin, side, whole, symmetry: Symmetry::NONE }
    }

    /// Anywhere.
    pub(super) fn draw(whole: usize, side: usize, served: Symmetries, draw: &mut Draw) -> Self {
        let room = whole - side + 1;
        let (x, y) = (draw.index(room), draw.index(room));
        Self { x, y, side, whole, symmetry: Symmetry::draw(served, draw) }
    }

    /// Anywhere with a place in it, at least an eighth of its side from the border where the larger square allows.
    pub(super) fn around(
        [column, row]: [usize; 2],
        whole: usize,
        side: usize,
        served: Symmetries,
        draw: &mut Draw,
    ) -> Self {
        let mut first = |at: usize| {
            let high = at.saturating_sub(side / 8).min(whole - side);
            let low = (at + side / 8 + 1).saturating_sub(side).min(high);
            low + draw.index(high - low + 1)
        };
        let (x, y) = (first(column), first(row));
        Self { x, y, side, whole, symmetry: Symmetry::draw(served, draw) }
    }

    /// Where a place of the larger square lies in the turned window: right and down of its middle, half sides.
    pub(super) fn place(self, [column, row]: [f64; 2]) -> [f64; 2] {
        let half = self.side as f64 / 2.0;
        let offset = |at: f64, first: usize| (at - first as f64) / half - 1.0;
        self.symmetry.moved([offset(column, self.x), offset(row, self.y)])
    }

    /// The pixels of the window in the order of the target's rows, as indices into the larger square.
    pub(super) fn indices(self) -> impl Iterator<Item = usize> {
        (0..self.side).flat_map(move |y| {
            (0..self.side).map(move |x| {
                let (from_x, from_y) = self.symmetry.source(x, y, self.side);
                (self.y + from_y) * self.whole + self.x + from_x
            })
        })
    }
}

/// A change of colours: one table of 256 values for each of red, green and blue.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Colours(Box<[[u8; 256]; 3]>);

impl Colours {
    /// A mild change: brightness, contrast and gamma of the whole, a gain for each channel, each by about
    /// `strength`. `strength` 0 changes nothing.
    pub(super) fn draw(strength: f64, draw: &mut Draw) -> Self {
        let mut range = |share: f64| draw.range(-strength * share, strength * share);
        let (brightness, contrast, gamma) = (0.5 * range(1.0), range(1.5), range(1.5));
        let gains = [range(0.5), range(0.5), range(0.5)];
        let table = |gain: f64| {
            std::array::from_fn(|value| {
                let unit = libm::pow(value as f64 / 255.0, libm::exp(gamma));
                let changed = (unit * (1.0 + gain) - 0.5) * (1.0 + contrast) + 0.5 + brightness;
                // The cast saturates at both ends.
                (changed * 255.0 + 0.5) as u8
            })
        };
        Self(Box::new(gains.map(table)))
    }

    /// One pixel.
    pub(super) fn of(&self, rgb: [u8; 3]) -> [u8; 3] {
        std::array::from_fn(|channel| self.0[channel][usize::from(rgb[channel])])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_eight_symmetries_are_all_different_and_keep_every_pixel() {
        let side = 3;
        let images: Vec<Vec<usize>> = Symmetry::ALL
            .map(|symmetry| Crop { symmetry, ..Crop::centre(side, side) }.indices().collect())
            .into();
        for (i, image) in images.iter().enumerate() {
            let mut sorted = image.clone();
            sorted.sort_unstable();
            assert_eq!(sorted, (0..9).collect::<Vec<_>>());
            assert!(images[..i].iter().all(|other| other != image), "{i}");
        }
        assert_eq!(images[0], (0..9).collect::<Vec<_>>());
        // Mirrored left to right.
        assert_eq!(images[1], [2, 1, 0, 5, 4, 3, 8, 7, 6]);
    }

    #[test]
    fn a_mirror_keeps_north_up() {
        let draw = &mut Draw::new(&[2]);
        let drawn: Vec<Symmetry> =
            (0..32).map(|_| Symmetry::draw(Symmetries::Mirror, draw)).collect();
        assert!(drawn.contains(&Symmetry(0)) && drawn.contains(&Symmetry(1)));
        assert!(drawn.iter().all(|symmetry| symmetry.moved([0.3, -0.8])[1] == -0.8));
    }

    #[test]
    fn crops_lie_inside_and_reach_both_ends() {
        let mut draw = Draw::new(&[1]);
        let (mut first, mut last) = (false, false);
        for _ in 0..500 {
            let crop = Crop::draw(20, 16, Symmetries::Square, &mut draw);
            assert!(crop.x <= 4 && crop.y <= 4);
            first |= crop.x == 0;
            last |= crop.x == 4;
            assert!(crop.indices().all(|index| index < 400));
        }
        assert!(first && last);
        let centre = Crop::centre(20, 16);
        assert_eq!(centre.indices().next(), Some(2 * 20 + 2));
    }

    #[test]
    fn a_landmark_stays_where_the_panorama_shows_it() {
        // Columns of the panorama hold their azimuth; a landmark is one pixel of the image.
        let (side, width) = (64, 720);
        let (camera, landmark) = ([40, 20], [9, 51]);
        let azimuth = |[x, y]: [f64; 2]| libm::atan2(x, -y).to_degrees().rem_euclid(360.0);
        let between = |a: [usize; 2], b: [usize; 2]| {
            azimuth([b[0] as f64 - a[0] as f64, b[1] as f64 - a[1] as f64])
        };
        let column_of = |azimuth: f64| ((azimuth / 360.0 + 0.5).fract() * width as f64) as usize;
        let true_column = column_of(between(camera, landmark));
        for symmetry in Symmetry::ALL {
            let crop = Crop { symmetry, ..Crop::centre(side, side) };
            let image: Vec<usize> = crop.indices().collect();
            let find = |[x, y]: [usize; 2]| {
                let at = image.iter().position(|index| *index == y * side + x).expect("is there");
                [at % side, at / side]
            };
            let [x, y] = crop.place(camera.map(|v| v as f64 + 0.5));
            let pixel = [x, y].map(|v| ((v + 1.0) * side as f64 / 2.0 - 0.5) as usize);
            assert_eq!(pixel, find(camera), "{symmetry:?}");
            let seen = column_of(between(find(camera), find(landmark)));
            let from = symmetry.panorama_column(seen, width);
            assert!(from.abs_diff(true_column) <= 1, "{symmetry:?}: {from}, not {true_column}");
        }
    }

    #[test]
    fn crops_around_a_place_hold_it() {
        let mut draw = Draw::new(&[4]);
        for at in [[0, 0], [63, 63], [20, 41], [32, 5]] {
            for _ in 0..50 {
                let crop = Crop::around(at, 64, 32, Symmetries::Square, &mut draw);
                assert!(crop.x + 32 <= 64 && crop.y + 32 <= 64);
                let place = crop.place(at.map(|v| v as f64 + 0.5));
                assert!(place.iter().all(|v| v.abs() < 1.0), "{at:?} {crop:?}");
            }
        }
        assert_eq!(Crop::around([5, 9], 32, 32, Symmetries::None, &mut draw), Crop::centre(32, 32));
    }

    #[test]
    fn colours_change_mildly_and_no_strength_changes_nothing() {
        let same = Colours::draw(0.0, &mut Draw::new(&[3]));
        for value in [0_u8, 1, 77, 128, 254, 255] {
            assert_eq!(same.of([value; 3]), [value; 3]);
        }
        let mut moved = 0;
        for seed in 0..50 {
            let colours = Colours::draw(0.1, &mut Draw::new(&[seed]));
            let [r, g, b] = colours.of([128; 3]);
            moved += usize::from([r, g, b] != [128; 3]);
            for value in [r, g, b] {
                assert!(value.abs_diff(128) < 40, "{value}");
            }
            // Darker stays darker.
            let ramp: Vec<u8> = (0..=255).map(|value| colours.of([value; 3])[0]).collect();
            assert!(ramp.is_sorted());
        }
        assert!(moved > 45, "{moved}");
    }
}
