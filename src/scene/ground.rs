//! How the ground looks: streets with their markings, painted patches, lawns, beach and water.
//! Pictures only; no height depends on it.

use super::index::CellGrid;
use super::layout::{Layout, SHORE_STRIP_M, Use};
use super::noise::{cell, fractal, value};
use super::object::{Colour, Cover, Patch, rgb};
use super::shape::Bounds;
use super::spec::Season;
use super::streets::{KERB_M, SIDE_WIDTH_M, StreetPoint, Streets, VERGE_END_M};
use std::collections::BTreeMap;

/// Colour of a point and a number that differs across every drawn edge (for antialiasing).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Paint {
    pub colour: Colour,
    pub key: u32,
}

pub(super) fn mix(a: Colour, b: Colour, share: f32) -> Colour {
    let t = share.clamp(0.0, 1.0);
    [0, 1, 2].map(|i| a[i] + (b[i] - a[i]) * t)
}

pub(super) fn scale(a: Colour, by: f32) -> Colour {
    a.map(|c| c * by)
}

const WHITE_LINE: Colour = rgb(218, 218, 214);
const YELLOW_LINE: Colour = rgb(206, 164, 62);

/// Everything painted on the ground of a scene.
#[derive(Clone, Debug)]
pub(super) struct GroundPaint {
    patches: Vec<Patch>,
    grid: CellGrid,
    uses: BTreeMap<[i64; 2], Use>,
    season: Season,
    seed: u32,
}

impl GroundPaint {
    pub fn new(layout: &Layout, area: Bounds, season: Season, seed: u64) -> Self {
        // The last painted comes first in a cell.
        let patches: Vec<Patch> = layout.patches.iter().rev().copied().collect();
        let boxes: Vec<Bounds> = patches.iter().map(|p| p.rect.bounds()).collect();
        let grid = CellGrid::new(area, &boxes);
        let seed = crate::random::mix(seed) as u32;
        Self { patches, grid, uses: layout.uses.clone(), season, seed }
    }

    /// The ground at a point, `inland` metres from the shore.
    pub fn at(&self, streets: &Streets, x: f64, y: f64, inland: f64) -> Paint {
        if inland < 0.0 {
            return self.water(x, y, -inland);
        }
        if inland < SHORE_STRIP_M {
            return self.beach(x, y, inland);
        }
        let place = streets.locate(x, y);
        if place.kerb < 0.0 {
            return self.carriageway(&place, x, y);
        }
        let patch = self.grid.over(x, y).iter().map(|i| &self.patches[*i as usize]).find_map(|p| {
            let (u, v) = p.rect.local(x, y);
            p.rect.holds(u, v).then_some((p, u, v))
        });
        if let Some((patch, u, v)) = patch {
            let paint = self.cover(patch.cover, x, y, Some((patch, u, v)));
            return Paint { key: paint.key + 64 * (1 + patch.seed % 1000), ..paint };
        }
        let used = self.block_use(streets, &place);
        if place.kerb < SIDE_WIDTH_M {
            return self.pavement(&place, used, x, y);
        }
        let paint = self.cover(used.cover(), x, y, None);
        Paint { key: paint.key + 40, ..paint }
    }

    fn block_use(&self, streets: &Streets, place: &StreetPoint) -> Use {
        let number = |family: usize| {
            let below = place.cell[family].checked_sub(1)?;
            streets.families[family].get(below).map(|s| s.number)
        };
        let index = [number(0), number(1)];
        let [Some(i), Some(j)] = index else { return Use::Park };
        self.uses.get(&[i, j]).copied().unwrap_or(Use::Park)
    }

    fn water(&self, x: f64, y: f64, out: f64) -> Paint {
        let swell = fractal(x / 5.0 + y / 11.0, y / 3.1, self.seed, 3);
        let ripple = value(x * 1.9 + y * 0.6, y * 3.4, self.seed ^ 1);
        let drift = fractal(x / 38.0, y / 38.0, self.seed ^ 2, 3);
        let depth = 1.0 - libm::expf(-(out as f32) / (7.0 + 6.0 * drift));
        let shallow = rgb(118, 116, 88);
        let deep = mix(rgb(26, 46, 62), rgb(34, 62, 74), drift);
        let body = mix(shallow, deep, depth);
        let colour = scale(body, 0.82 + 0.22 * swell + 0.18 * (ripple - 0.5));
        let foam = out < 0.35 + 0.5 * f64::from(ripple);
        Paint {
            colour: if foam { mix(colour, rgb(206, 206, 198), 0.55) } else { colour },
            key: u32::from(foam),
        }
    }

    fn beach(&self, x: f64, y: f64, inland: f64) -> Paint {
        let grain = value(x * 7.0, y * 7.0, self.seed ^ 3);
        let patchy = fractal(x / 3.0, y / 3.0, self.seed ^ 4, 4);
        if (5.4..7.6).contains(&inland) {
            let joint = (inland * 0.9).fract() < 0.04;
            let tone = if joint { 0.8 } else { 0.95 + 0.1 * patchy };
            return Paint {
                colour: scale(rgb(176, 170, 160), tone + 0.06 * (grain - 0.5)),
                key: 3,
            };
        }
        let weed = patchy > 0.62 && inland > 2.5;
        let wet = (1.0 - inland as f32 / 2.0).clamp(0.0, 1.0);
        let dry = mix(rgb(190, 176, 148), rgb(146, 136, 118), patchy);
        let sand = if weed { rgb(112, 114, 68) } else { mix(dry, rgb(104, 96, 80), wet) };
        Paint { colour: scale(sand, 0.9 + 0.22 * grain), key: 2 }
    }

    fn asphalt(&self, x: f64, y: f64, tone: Colour) -> Colour {
        let broad = fractal(x / 6.0, y / 6.0, self.seed ^ 5, 4);
        let grain = value(x * 8.5, y * 8.5, self.seed ^ 6);
        let crack = (value(x * 0.42 + 0.15 * y, y * 0.45, self.seed ^ 7) - 0.5).abs();
        let mut shade = 0.84 + 0.3 * broad + 0.1 * (grain - 0.5);
        if crack < 0.006 {
            shade *= 0.8;
        }
        scale(tone, shade)
    }

    fn carriageway(&self, place: &StreetPoint, x: f64, y: f64) -> Paint {
        let on = [place.on(0), place.on(1)];
        // Corners belong to no lane; the wider road runs through a crossing.
        let family = match on {
            [true, false] => 0,
            [false, true] => 1,
            _ => usize::from(place.nearest[1].arterial && !place.nearest[0].arterial),
        };
        let street = &place.nearest[family];
        let (across, along) = (place.across(family), place.along(family));
        let street_seed =
            self.seed ^ (street.number as u32).wrapping_mul(2_654_435_761) ^ family as u32;
        let surface = cell(street.number as i32, family as i32, self.seed ^ 8);
        let tone = if street.arterial || surface < 0.62 {
            mix(rgb(84, 84, 88), rgb(122, 121, 120), cell(1, street.number as i32, street_seed))
        } else {
            rgb(158, 155, 148)
        };
        let mut colour = self.asphalt(x, y, tone);
        // Wheel tracks, and the darker middle where oil drips.
        let lane = (across.abs() / 3.3).fract() as f32 - 0.5;
        colour = scale(colour, 1.0 - 0.06 * (1.0 - 9.0 * (lane.abs() - 0.22).abs()).max(0.0));
        // Slabs of concrete streets, and trenches that were dug up and filled.
        if tone[0] > 0.35 && ((along / 4.5).fract().abs() < 0.012 || across.abs() < 0.05) {
            colour = scale(colour, 0.72);
        }
        let (ci, cj) = ((along / 9.0).floor() as i32, (across / 2.4).floor() as i32);
        if cell(ci, cj, street_seed ^ 9) < 0.07 {
            colour = scale(colour, 0.84);
        }
        let hole = [along / 19.0, across / 3.0].map(|v| v - v.floor() - 0.5);
        if cell((along / 19.0).floor() as i32, (across / 3.0).floor() as i32, street_seed ^ 10)
            < 0.3
            && libm::hypot(hole[0] * 19.0, hole[1] * 3.0) < 0.36
        {
            return Paint { colour: scale(rgb(70, 68, 66), 1.0), key: 12 };
        }
        let marked = if on == [true, true] || on == [false, false] {
            None
        } else {
            self.marking(place, family)
        };
        match marked {
            Some(line) => {
                let wear = fractal(x * 1.3, y * 1.3, self.seed ^ 11, 3);
                let share = 0.95 - 0.75 * (wear - 0.38).max(0.0) * 1.6;
                Paint { colour: mix(colour, line, share), key: 11 }
            }
            None => Paint { colour, key: 10 },
        }
    }

    /// Lines on the carriageway of a family, outside crossings.
    fn marking(&self, place: &StreetPoint, family: usize) -> Option<Colour> {
        let (street, other) = (&place.nearest[family], &place.nearest[1 - family]);
        let (across, along) = (place.across(family), place.along(family));
        let signed = along - other.at;
        let from_crossing = signed.abs() - other.half_width;
        let d = across.abs();
        let crossing_seed =
            cell(place.nearest[0].number as i32, place.nearest[1].number as i32, self.seed ^ 12);
        let important = street.arterial || other.arterial;
        if important || crossing_seed < 0.4 {
            if (1.0..3.9).contains(&from_crossing) && d < street.half_width - 0.35 {
                return ((across / 1.25).rem_euclid(1.0) < 0.5).then_some(WHITE_LINE);
            }
            // Traffic keeps right; who comes towards the crossing stops.
            let right = if family == 0 { across } else { -across };
            let coming = right * -signed > 0.0;
            if coming
                && (4.8..5.25).contains(&from_crossing)
                && d > 0.2
                && d < street.half_width - 0.4
            {
                return Some(WHITE_LINE);
            }
        }
        if from_crossing < 5.6 {
            return None;
        }
        if street.arterial {
            if (0.09..0.24).contains(&d) {
                return Some(YELLOW_LINE);
            }
            if (d - 3.3).abs() < 0.07 && (along / 9.0).rem_euclid(1.0) < 0.34 {
                return Some(WHITE_LINE);
            }
            if (d - street.half_width + 0.3).abs() < 0.06 {
                return Some(WHITE_LINE);
            }
        } else if cell(street.number as i32, 3 + family as i32, self.seed ^ 13) < 0.55
            && d < 0.07
            && (along / 7.5).rem_euclid(1.0) < 0.4
        {
            return Some(YELLOW_LINE);
        }
        None
    }

    fn pavement(&self, place: &StreetPoint, used: Use, x: f64, y: f64) -> Paint {
        let grain = value(x * 8.0, y * 8.0, self.seed ^ 14);
        let broad = fractal(x / 4.0, y / 4.0, self.seed ^ 15, 3);
        let concrete = scale(rgb(164, 160, 152), 0.86 + 0.2 * broad + 0.08 * (grain - 0.5));
        if place.kerb < KERB_M {
            return Paint { colour: scale(concrete, 1.08), key: 20 };
        }
        let green = matches!(used, Use::Suburb | Use::Park | Use::Forest);
        if place.kerb < VERGE_END_M {
            if green {
                return Paint { key: 21, ..self.cover(Cover::Lawn, x, y, None) };
            }
            return Paint { colour: scale(concrete, 0.93), key: 22 };
        }
        let family = usize::from(
            place.across(1).abs() - place.nearest[1].half_width
                < place.across(0).abs() - place.nearest[0].half_width,
        );
        let joint = (place.along(family) / 1.5).rem_euclid(1.0) < 0.035;
        if used == Use::Forest && place.kerb > 3.6 {
            return Paint { key: 23, ..self.cover(Cover::Litter, x, y, None) };
        }
        Paint { colour: if joint { scale(concrete, 0.8) } else { concrete }, key: 24 }
    }

    fn lawn(&self, x: f64, y: f64, dryness: f32) -> Colour {
        let broad = fractal(x / 11.0, y / 11.0, self.seed ^ 16, 4);
        let tuft = fractal(x * 1.1, y * 1.1, self.seed ^ 17, 3);
        let blade = value(x * 6.5, y * 6.5, self.seed ^ 18);
        let (green, dry, bias) = match self.season {
            Season::Spring => (rgb(92, 120, 52), rgb(128, 134, 72), -0.3),
            Season::Summer => (rgb(94, 106, 54), rgb(162, 138, 92), 0.02),
            Season::Autumn => (rgb(98, 108, 56), rgb(138, 122, 80), -0.05),
            Season::Winter => (rgb(92, 98, 60), rgb(124, 116, 84), 0.0),
        };
        let share =
            (2.6 * (broad - 0.5) + 0.5 + 1.2 * (tuft - 0.5) + bias + dryness).clamp(0.0, 1.0);
        scale(mix(green, dry, share), 0.82 + 0.2 * tuft + 0.17 * blade)
    }

    fn slabs(&self, x: f64, y: f64, base: Colour, size: f64) -> Colour {
        let (i, j) = ((x / size).floor(), (y / size).floor());
        let tone = cell(i as i32, j as i32, self.seed ^ 19);
        let edge = (x / size - i).min(y / size - j) < 0.05 / size;
        let grain = value(x * 9.0, y * 9.0, self.seed ^ 20);
        let broad = fractal(x / 5.0, y / 5.0, self.seed ^ 21, 3);
        scale(
            base,
            (0.86 + 0.1 * tone + 0.14 * broad + 0.06 * grain) * if edge { 0.78 } else { 1.0 },
        )
    }

    fn cover(&self, cover: Cover, x: f64, y: f64, patch: Option<(&Patch, f64, f64)>) -> Paint {
        let grain = value(x * 7.5, y * 7.5, self.seed ^ 22);
        let broad = fractal(x / 4.5, y / 4.5, self.seed ^ 23, 4);
        let (u, v) = patch.map_or((x, y), |p| (p.1, p.2));
        let rect = patch.map(|p| p.0.rect);
        let line = |key: u32, base: Colour, hit: bool| Paint {
            colour: if hit { mix(base, WHITE_LINE, 0.85) } else { base },
            key: key + u32::from(hit),
        };
        match cover {
            Cover::Lawn => Paint { colour: self.lawn(x, y, self.garden_dryness(x, y)), key: 30 },
            Cover::Meadow => {
                let bare = fractal(x / 7.0, y / 7.0, self.seed ^ 24, 4);
                let soil = scale(rgb(140, 120, 90), 0.85 + 0.25 * grain);
                let grass = self.lawn(x, y, 0.12);
                Paint { colour: mix(grass, soil, (bare - 0.58) * 7.0), key: 31 }
            }
            Cover::Litter => {
                let moss = mix(rgb(76, 70, 48), rgb(62, 76, 42), broad);
                Paint { colour: scale(moss, 0.7 + 0.5 * grain), key: 32 }
            }
            Cover::Asphalt => Paint { colour: self.asphalt(x, y, rgb(104, 104, 106)), key: 33 },
            Cover::Concrete => Paint { colour: self.slabs(u, v, rgb(170, 166, 158), 3.0), key: 34 },
            Cover::Paving => Paint { colour: self.slabs(u, v, rgb(158, 148, 138), 0.8), key: 35 },
            Cover::Gravel => {
                let base = mix(rgb(156, 148, 136), rgb(126, 120, 110), broad);
                Paint { colour: scale(base, 0.78 + 0.42 * grain), key: 36 }
            }
            Cover::Soil => {
                let base = mix(rgb(142, 116, 84), rgb(108, 88, 66), broad);
                Paint { colour: scale(base, 0.82 + 0.3 * grain), key: 37 }
            }
            Cover::Mulch => {
                let base = mix(rgb(98, 72, 54), rgb(74, 64, 46), broad);
                Paint { colour: scale(base, 0.7 + 0.55 * grain), key: 38 }
            }
            Cover::Sand => {
                Paint { colour: scale(rgb(206, 188, 150), 0.85 + 0.25 * grain), key: 39 }
            }
            Cover::Pool => {
                let glint = (value(x * 2.6, y * 2.6, self.seed ^ 25) - 0.5).abs() < 0.07;
                let rim =
                    rect.is_some_and(|r| r.half_u - u.abs() < 0.25 || r.half_v - v.abs() < 0.25);
                let water = if glint { rgb(140, 214, 224) } else { rgb(74, 172, 196) };
                Paint {
                    colour: if rim { rgb(214, 210, 202) } else { water },
                    key: 41 + u32::from(rim),
                }
            }
            Cover::Stalls => {
                let half = rect.map_or(0.0, |r| r.half_u);
                let off = ((u + half) / super::layout::STALL_WIDTH_M).fract();
                let edge = off.min(1.0 - off) * super::layout::STALL_WIDTH_M;
                let stain = fractal(x / 1.6, y / 1.6, self.seed ^ 26, 3);
                let base = scale(self.asphalt(x, y, rgb(104, 104, 106)), 1.08 - 0.2 * stain);
                line(43, base, edge < 0.06)
            }
            Cover::TennisCourt => {
                let inner = u.abs() < 11.9 && v.abs() < 5.5;
                let near = |a: f64, b: f64| (a.abs() - b).abs() < 0.05;
                let long = u.abs() < 11.93 && (near(v, 5.48) || near(v, 4.11));
                let cross = v.abs() < 5.53 && near(u, 11.88);
                let service = (near(u, 6.4) && v.abs() < 4.11) || (v.abs() < 0.04 && u.abs() < 6.4);
                let net = u.abs() < 0.06 && v.abs() < 6.4;
                let wear = 0.9 + 0.16 * broad + 0.06 * grain;
                let base = if inner { rgb(70, 104, 140) } else { rgb(84, 122, 88) };
                line(46 + 2 * u32::from(inner), scale(base, wear), long || cross || service || net)
            }
            Cover::Track => {
                let bed = mix(rgb(148, 140, 130), rgb(112, 106, 100), broad);
                let bed = scale(bed, 0.74 + 0.46 * grain);
                let sleeper = (u / 0.62).rem_euclid(1.0) < 0.42 && v.abs() < 1.25;
                let rail = (v.abs() - 0.75).abs() < 0.07;
                if rail {
                    Paint { colour: rgb(150, 136, 124), key: 56 }
                } else if sleeper {
                    Paint { colour: scale(rgb(158, 150, 138), 0.8 + 0.3 * grain), key: 55 }
                } else {
                    Paint { colour: scale(bed, 0.8), key: 54 }
                }
            }
            Cover::Pitch => {
                let (hu, hv) = rect.map_or((1.0, 1.0), |r| (r.half_u, r.half_v));
                let mown = if (u / 5.0).rem_euclid(2.0) < 1.0 { 1.07 } else { 0.95 };
                let base = scale(self.lawn(x, y, -0.45), mown);
                let border = (u.abs() - hu + 2.0).abs() < 0.07 && v.abs() < hv - 1.9
                    || (v.abs() - hv + 2.0).abs() < 0.07 && u.abs() < hu - 1.9;
                let middle =
                    u.abs() < 0.07 && v.abs() < hv - 2.0 || (libm::hypot(u, v) - 6.0).abs() < 0.08;
                line(50, base, border || middle)
            }
        }
    }

    /// Some gardens are watered.
    fn garden_dryness(&self, x: f64, y: f64) -> f32 {
        1.5 * (value(x / 17.0, y / 17.0, self.seed ^ 27) - 0.5)
    }
}
