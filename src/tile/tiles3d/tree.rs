//! The quadtree, made from its leaves up.

use super::content::Content;
use super::texture::{self, Texture};
use super::tileset::{self, Bounds};
use super::{Node, Tiles3dError, Tiles3dOptions, Tiles3dSummary, levels};
use crate::batch::{AtomicFolder, Interrupt, Progress};
use crate::tile::frame::LocalFrame;
use crate::tile::surface::simplify::{Target, simplify_placed};
use crate::tile::surface::store::SurfaceStore;
use crate::tile::surface::weld::weld;
use crate::tile::surface::{MeshTile, TILE, TileIndex};
use serde_json::Value;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};

/// Levels of one `tileset.json`: a city's tree is cut into files of at most 1365 tiles, so that neither the
/// writer nor a viewer holds the whole list.
pub(super) const LEVELS_PER_FILE: u32 = 5;

/// Pixels of a tile's picture that its error counts at least where the picture is coarser than the city's: a viewer
/// that refines above 16 pixels of error (CesiumJS's default) then shows none larger than two.
const TEXELS: f64 = 8.0;

/// What all tiles share.
pub(super) struct Forest<'a> {
    store: &'a SurfaceStore<'a>,
    frame: &'a LocalFrame,
    options: &'a Tiles3dOptions,
    folder: &'a AtomicFolder,
    progress: &'a Progress,
    interrupt: &'a Interrupt,
    size: [u32; 2],
    /// Ground metres per model pixel, the larger.
    gsd_m: f64,
    step_m: f64,
    top: u32,
    pub(super) levels_per_file: u32,
    /// One tile failed, so that the others need not be made.
    failed: AtomicBool,
}

/// A finished tile: what its parent and the list of tiles need.
pub(super) struct Built {
    mesh: MeshTile,
    texture: Texture,
    /// Of its content and that of all below it.
    pub(super) bounds: Bounds,
    /// Distance from the whole surface, metres.
    geometry_m: f64,
    /// What the tile states.
    pub(super) error_m: f64,
    /// It and those below it.
    pub(super) tile: Value,
    levels: Vec<Tally>,
    bytes: u64,
}

/// Of one level.
#[derive(Clone, Copy, Default)]
struct Tally {
    tiles: u64,
    triangles: u64,
    error_m: f64,
}

impl Built {
    pub(super) fn summary(&self, step_m: f64, more_bytes: u64) -> Tiles3dSummary {
        Tiles3dSummary {
            tiles: self.levels.iter().map(|level| level.tiles).collect(),
            triangles: self.levels.iter().map(|level| level.triangles).collect(),
            error_m: self.levels.iter().map(|level| level.error_m).collect(),
            step_m,
            bytes: self.bytes + more_bytes,
        }
    }
}

impl<'a> Forest<'a> {
    pub(super) fn new(
        store: &'a SurfaceStore<'a>,
        frame: &'a LocalFrame,
        options: &'a Tiles3dOptions,
        folder: &'a AtomicFolder,
        progress: &'a Progress,
        interrupt: &'a Interrupt,
    ) -> Self {
        let city = store.slabs().city;
        let [across, down] = city.gsd_m();
        Self {
            store,
            frame,
            options,
            folder,
            progress,
            interrupt,
            size: city.size,
            gsd_m: across.max(down),
            step_m: step(city.size, city.levels.ends, frame),
            top: levels(city.size.map(|size| size.div_ceil(TILE))) - 1,
            levels_per_file: LEVELS_PER_FILE,
            failed: AtomicBool::new(false),
        }
    }

    pub(super) fn step_m(&self) -> f64 {
        self.step_m
    }

    /// The root with all below it; `None` where there are no triangles.
    pub(super) fn build(&self) -> Result<Option<Built>, Tiles3dError> {
        self.tile(Node { level: self.top, index: TileIndex { row: 0, column: 0 } })
    }

    fn tile(&self, node: Node) -> Result<Option<Built>, Tiles3dError> {
        if self.interrupt.requested() || self.failed.load(Ordering::Relaxed) {
            return Err(Tiles3dError::Interrupted);
        }
        let built = if node.level == 0 { self.leaf(node) } else { self.branch(node) };
        if built.is_err() {
            self.failed.store(true, Ordering::Relaxed);
        }
        built
    }

    /// Columns and rows of the city under a tile.
    fn rectangle(&self, Node { level, index: TileIndex { row, column } }: Node) -> [Range<u32>; 2] {
        let side = u64::from(TILE) << level;
        [(column, self.size[0]), (row, self.size[1])].map(|(index, size)| {
            // Within the city, which 32 bits count.
            let [from, to] =
                [0, 1].map(|k| ((u64::from(index) + k) * side).min(u64::from(size)) as u32);
            from..to
        })
    }

    fn leaf(&self, node: Node) -> Result<Option<Built>, Tiles3dError> {
        if self.store.entry(node.index).is_none() {
            return Ok(None);
        }
        let mesh = self.store.read_tile(node.index)?;
        let rectangle = self.rectangle(node);
        let size = [0, 1].map(|axis| rectangle[axis].len() as u32);
        let slabs = self.store.slabs();
        let colours = slabs.colours(rectangle).map_err(Tiles3dError::io(slabs.out))?;
        let texture = Texture::of_colours(size, &colours);
        let built = self.finish(node, &mesh, texture, Vec::new())?;
        self.progress.add(1);
        Ok(Some(built))
    }

    fn branch(&self, node: Node) -> Result<Option<Built>, Tiles3dError> {
        let [a, b, c, d] = node.children();
        let make = |child| if self.exists(child) { self.tile(child) } else { Ok(None) };
        let ((a_built, b_built), (c_built, d_built)) = rayon::join(
            || rayon::join(|| make(a), || make(b)),
            || rayon::join(|| make(c), || make(d)),
        );
        let results = [a_built, b_built, c_built, d_built];
        let mut children = Vec::with_capacity(4);
        let mut stopped = false;
        for (child, result) in [a, b, c, d].into_iter().zip(results) {
            match result {
                Ok(Some(built)) => children.push((child, built)),
                Ok(None) => {}
                // Of the children that another one's error stopped.
                Err(Tiles3dError::Interrupted) => stopped = true,
                Err(error) => return Err(error),
            }
        }
        if stopped {
            return Err(Tiles3dError::Interrupted);
        }
        if children.is_empty() {
            return Ok(None);
        }
        let mesh = weld(children.iter().map(|(_, built)| &built.mesh));
        let texture = self.texture(node, &children);
        let children = children.into_iter().map(|(_, built)| built).collect();
        Ok(Some(self.finish(node, &mesh, texture, children)?))
    }

    /// Whether a tile has a part of the city.
    fn exists(&self, node: Node) -> bool {
        self.rectangle(node).iter().all(|range| !range.is_empty())
    }

    /// A parent's picture, of its children's.
    fn texture(&self, node: Node, children: &[(Node, Built)]) -> Texture {
        let texel = texture::texel(node.level);
        let rectangle = self.rectangle(node);
        let mut picture =
            Texture::blank([0, 1].map(|axis| (rectangle[axis].len() as u32).div_ceil(texel)));
        for (child, built) in children {
            let inside = self.rectangle(*child);
            let at = [0, 1].map(|axis| (inside[axis].start - rectangle[axis].start) / texel);
            picture.put(&built.texture, at, texel / texture::texel(child.level));
        }
        picture
    }

    /// Simplifies a tile's mesh, writes its file, and says what its parent needs.
    fn finish(
        &self,
        node: Node,
        whole: &MeshTile,
        texture: Texture,
        children: Vec<Built>,
    ) -> Result<Built, Tiles3dError> {
        let Node { level, index: TileIndex { row, column } } = node;
        let place = |vertex: [f64; 3]| self.frame.place(vertex).map(|value| self.rounded(value));
        let wanted_m = self.options.error_m * f64::from(2_u32.saturating_pow(level));
        let target = Target { error_m: Some(wanted_m), triangles: None };
        let (mut mesh, mut own_m) = simplify_placed(whole, place, target, true)
            .map_err(|source| Tiles3dError::Simplify { level, row, column, source })?;
        if mesh.triangles.is_empty() {
            // A speck smaller than the error: a tile has to show something.
            (mesh, own_m) = (whole.clone(), 0.0);
        }
        let metres: Vec<[f64; 3]> = mesh.vertices.iter().map(|vertex| place(*vertex)).collect();
        let mut bounds = metres.iter().fold([[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]], widen);
        let middle = [0, 1, 2].map(|k| self.rounded((bounds[0][k] + bounds[1][k]) / 2.0));
        let corner = self.rectangle(node).map(|range| range.start);
        let texel = texture::texel(level);
        let content =
            Content { mesh: &mesh, metres: &metres, middle, texture: &texture, corner, texel };
        let file = content.encode().map_err(|error| Tiles3dError::Content {
            level,
            row,
            column,
            reason: error.to_string(),
        })?;
        let name = node.file();
        self.write(&name, &file)?;

        // The finest level is what it was simplified by and what its positions were rounded by.
        let below = children.iter().map(|child| child.geometry_m).fold(0.0, f64::max);
        let geometry_m = own_m + if level == 0 { self.step_m } else { below };
        let picture_m = if texel > 1 { TEXELS * f64::from(texel) * self.gsd_m } else { 0.0 };
        let error_m = children.iter().map(|child| child.error_m).fold(0.0, f64::max);
        let error_m = error_m.max(geometry_m).max(picture_m);
        let mut built = Built {
            bounds,
            geometry_m,
            error_m,
            tile: Value::Null,
            levels: vec![Tally::default(); level as usize + 1],
            bytes: file.len() as u64,
            mesh,
            texture,
        };
        let mut tiles = Vec::with_capacity(children.len());
        for child in children {
            bounds = child.bounds.iter().fold(bounds, widen);
            built.bytes += child.bytes;
            for (sum, level) in built.levels.iter_mut().zip(&child.levels) {
                sum.tiles += level.tiles;
                sum.triangles += level.triangles;
                sum.error_m = sum.error_m.max(level.error_m);
            }
            tiles.push(child.tile);
        }
        built.bounds = bounds;
        let triangles = built.mesh.triangles.len() as u64;
        built.levels[level as usize] = Tally { tiles: 1, triangles, error_m };
        built.tile = tileset::tile(bounds, error_m, &name, tiles);
        if level > 0 && level % self.levels_per_file == 0 && level < self.top {
            let name = format!("tileset-{level}-{row}-{column}.json");
            let text = tileset::text(&tileset::part(built.tile.take()));
            self.write(&name, &text)?;
            built.bytes += text.len() as u64;
            built.tile = tileset::tile(bounds, error_m, &name, Vec::new());
        }
        Ok(built)
    }

    fn write(&self, name: &str, bytes: &[u8]) -> Result<(), Tiles3dError> {
        self.folder.write(name, bytes).map_err(Tiles3dError::io(self.store.slabs().out))
    }

    /// To the nearest multiple of the step; division by a power of two is exact.
    fn rounded(&self, value: f64) -> f64 {
        (value / self.step_m).round() * self.step_m
    }
}

fn widen([low, high]: Bounds, at: &[f64; 3]) -> Bounds {
    [std::array::from_fn(|k| low[k].min(at[k])), std::array::from_fn(|k| high[k].max(at[k]))]
}

/// The smallest power of two of which 2^24 are as long as the city, metres: whole multiples of it, counted
/// from the middle of any tile, are 32-bit floats.
fn step(size: [u32; 2], ends: [f64; 2], frame: &LocalFrame) -> f64 {
    let [x, y] = size.map(f64::from);
    let mut bounds = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    for at in [[0.0, 0.0], [x, 0.0], [0.0, y], [x, y], [x / 2.0, y / 2.0]] {
        for z in ends {
            bounds = widen(bounds, &frame.place([at[0], at[1], z]));
        }
    }
    let extent = (0..3).map(|k| bounds[1][k] - bounds[0][k]).fold(1.0, f64::max);
    let mut step = 2.0_f64.powi(-24);
    while step * f64::from(1 << 24) < extent {
        step *= 2.0;
    }
    step
}
