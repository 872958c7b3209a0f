//! The city in as few pieces as fit, simplified on the way, in memory that does not grow with it.
//!
//! Tiles are joined two by two in both directions, and these groups again, up to the whole. A tile is
//! simplified with its border locked, then each group inside its own border: what was locked in between is
//! free there. A group that is too large is not joined: its quarters are final and handed on. So the
//! pieces come quarter by quarter: north-west, north-east, south-west, south-east, and so within each.
//!
//! Errors of the stages add up (the distance between surfaces obeys the triangle inequality), so each group
//! may spend half of what its parts left over, and a final piece the rest.

use super::simplify::{SimplifyError, Target, simplify_placed};
use super::store::{StoreError, SurfaceStore, tile_counts};
use super::weld::weld;
use super::{MeshTile, TILE, TileIndex};
use rayon::prelude::*;
use std::ops::Range;

/// Groups of up to 2^3 x 2^3 tiles are worked on by all cores at once, larger ones one after another.
const TOGETHER: u32 = 3;

/// Triangles of the largest group that is simplified again to an error: in a larger one the seams that became free
/// are some hundredths of it, and it is done on one core.
const AGAIN: u64 = 4_000_000;

/// Share of the triangles above which another simplification is not worth its time: of noise, and of groups where
/// only seams became free.
const MOST: f64 = 0.8;

/// A piece of the city.
#[derive(Clone, Debug, PartialEq)]
pub struct Piece {
    /// What it is made of.
    pub content: Content,
    /// Its number of vertices; at most so many of stored tiles.
    pub vertices: u64,
    /// Its number of triangles.
    pub triangles: u64,
    /// Largest distance to the surface as it was, metres.
    pub error_m: f64,
    /// Columns and rows that it covers, model pixels.
    pub rectangle: [Range<u32>; 2],
    /// Triangles of its tiles as they are stored.
    stored: u64,
    /// Whether the last simplification left more than [`MOST`].
    is_done: bool,
}

/// What a piece is made of.
#[derive(Clone, Debug, PartialEq)]
pub enum Content {
    /// Tiles as they are stored, still to be read and welded.
    Stored(Vec<TileIndex>),
    /// One mesh, grid coordinates.
    Simplified(MeshTile),
}

/// Why there are no pieces.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PartsError {
    /// A tile is not read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A mesh is not simplified.
    #[error(transparent)]
    Simplify(#[from] SimplifyError),
}

/// What the pieces of a city are to be.
pub struct Parts<'a> {
    /// The tiles.
    pub store: &'a SurfaceStore<'a>,
    /// Metres of a point in grid coordinates.
    pub place: &'a (dyn Fn([f64; 3]) -> [f64; 3] + Sync),
    /// How far to simplify: the error holds for every piece, the triangles are shared among them.
    pub target: Target,
    /// Whether a piece may be so large.
    pub fits: &'a (dyn Fn(&Piece) -> bool + Sync),
    /// Told how many more tiles were taken.
    pub progress: &'a (dyn Fn(u64) + Sync),
}

/// A square of 2^level x 2^level tiles.
#[derive(Clone, Copy)]
struct Node {
    level: u32,
    row: u32,
    column: u32,
}

/// What became of a group.
enum Group {
    /// One piece, or none where there are no triangles.
    One(Option<Piece>),
    /// It does not fit: pieces that are final.
    Split(Vec<Piece>),
}

impl Parts<'_> {
    /// Gives the pieces one after another, each with its number from 1 on and whether it is the only one. A piece
    /// that does not fit though it is a single tile is given too. Beside it, their number.
    ///
    /// # Errors
    /// The first error, the callback's too.
    pub fn each<E: From<PartsError>>(
        &self,
        mut give: impl FnMut(u32, bool, Piece) -> Result<(), E>,
    ) -> Result<u32, E> {
        let [columns, rows] = tile_counts(self.store.slabs());
        let level = columns.max(rows).next_power_of_two().trailing_zeros();
        let mut walk = Walk { pending: Vec::new(), count: 0, give: &mut give };
        match self.walk(Node { level, row: 0, column: 0 }, &mut walk)? {
            Some(piece) => {
                walk.count += 1;
                let piece = self.finished(piece)?;
                (walk.give)(1, true, piece)?;
            }
            None => self.flush(&mut walk)?,
        }
        Ok(walk.count)
    }

    /// Groups larger than [`TOGETHER`], one after another; pieces are handed on as soon as it is certain
    /// that they are final.
    fn walk<E: From<PartsError>>(
        &self,
        node: Node,
        walk: &mut Walk<'_, E>,
    ) -> Result<Option<Piece>, E> {
        if node.level <= TOGETHER {
            return match self.group(node)? {
                Group::One(piece) => Ok(piece),
                Group::Split(pieces) => {
                    walk.pending.extend(pieces);
                    self.flush(walk)?;
                    Ok(None)
                }
            };
        }
        let start = walk.pending.len();
        let emitted = walk.count;
        for quarter in self.quarters(node) {
            if let Some(piece) = self.walk(quarter, walk)? {
                walk.pending.push(piece);
            }
        }
        if walk.count == emitted {
            let pieces = walk.pending.split_off(start);
            match self.join(node, pieces)? {
                Group::One(piece) => return Ok(piece),
                Group::Split(pieces) => walk.pending.extend(pieces),
            }
        }
        // A group that does not fit is in none that does: neither are the quarters before it.
        self.flush(walk)?;
        Ok(None)
    }

    fn flush<E: From<PartsError>>(&self, walk: &mut Walk<'_, E>) -> Result<(), E> {
        for piece in std::mem::take(&mut walk.pending) {
            walk.count += 1;
            let piece = self.finished(piece)?;
            (walk.give)(walk.count, false, piece)?;
        }
        Ok(())
    }

    fn quarters(&self, Node { level, row, column }: Node) -> Vec<Node> {
        let counts = tile_counts(self.store.slabs());
        let level = level - 1;
        let all = [(0, 0), (0, 1), (1, 0), (1, 1)];
        let nodes = all.map(|(down, right)| Node {
            level,
            row: 2 * row + down,
            column: 2 * column + right,
        });
        let inside =
            |node: &Node| node.column << level < counts[0] && node.row << level < counts[1];
        nodes.into_iter().filter(inside).collect()
    }

    /// A group, on all cores.
    fn group(&self, node: Node) -> Result<Group, PartsError> {
        if node.level == 0 {
            return Ok(Group::One(self.tile(node)?));
        }
        let quarters = self.quarters(node);
        let groups: Result<Vec<Group>, PartsError> =
            quarters.into_par_iter().map(|quarter| self.group(quarter)).collect();
        let mut split = false;
        let mut pieces = Vec::new();
        for group in groups? {
            match group {
                Group::One(piece) => pieces.extend(piece),
                Group::Split(parts) => {
                    split = true;
                    pieces.extend(parts);
                }
            }
        }
        if split { Ok(Group::Split(pieces)) } else { self.join(node, pieces) }
    }

    fn tile(&self, Node { row, column, .. }: Node) -> Result<Option<Piece>, PartsError> {
        let index = TileIndex { row, column };
        let Some(entry) = self.store.entry(index) else { return Ok(None) };
        let size = self.store.slabs().city.size;
        let range = |tile: u32, size: u32| tile * TILE..((tile + 1) * TILE).min(size);
        let mut piece = Piece {
            content: Content::Stored(vec![index]),
            vertices: entry.vertices.into(),
            triangles: entry.triangles.into(),
            error_m: 0.0,
            rectangle: [range(column, size[0]), range(row, size[1])],
            stored: entry.triangles.into(),
            is_done: false,
        };
        if self.target != Target::default() {
            piece.content = Content::Simplified(self.store.read_tile(index)?);
            piece = self.simplified(piece, 0.5, 4.0)?;
            (self.progress)(1);
        }
        Ok(Some(piece))
    }

    /// Joins the pieces of a group if the whole fits.
    fn join(&self, node: Node, pieces: Vec<Piece>) -> Result<Group, PartsError> {
        if pieces.len() < 2 {
            return Ok(Group::One(pieces.into_iter().next()));
        }
        let mut whole = pieces[0].clone_without_content();
        for piece in &pieces[1..] {
            whole.vertices += piece.vertices;
            whole.triangles += piece.triangles;
            whole.stored += piece.stored;
            whole.error_m = whole.error_m.max(piece.error_m);
            whole.is_done &= piece.is_done;
            for (all, one) in whole.rectangle.iter_mut().zip(&piece.rectangle) {
                *all = all.start.min(one.start)..all.end.max(one.end);
            }
        }
        if !(self.fits)(&whole) {
            return Ok(Group::Split(pieces));
        }
        let mut stored = Vec::new();
        let mut meshes = Vec::new();
        for piece in pieces {
            match piece.content {
                Content::Stored(tiles) => stored.extend(tiles),
                Content::Simplified(mesh) => meshes.push(mesh),
            }
        }
        if meshes.is_empty() {
            whole.content = Content::Stored(stored);
            return Ok(Group::One(Some(whole)));
        }
        whole.content = Content::Simplified(weld(&meshes));
        drop(meshes);
        if self.is_enough(&whole) {
            return Ok(Group::One(Some(whole)));
        }
        let slack = 1.0 + 3.0 / f64::from(1_u32 << node.level.min(30));
        Ok(Group::One(Some(self.simplified(whole, 0.5, slack)?)))
    }

    /// A piece that will not be joined any more, with all that the target grants.
    fn finished(&self, piece: Piece) -> Result<Piece, PartsError> {
        if self.is_enough(&piece) { Ok(piece) } else { self.simplified(piece, 1.0, 1.0) }
    }

    /// Whether a group is too large to be simplified again or would stay much as it is, and there is no number of
    /// triangles to reach.
    fn is_enough(&self, group: &Piece) -> bool {
        self.target.triangles.is_none() && (group.triangles > AGAIN || group.is_done)
    }

    /// Spends a share of the error that is left; the piece's share of the triangles, times a slack, remains.
    fn simplified(&self, mut piece: Piece, share: f64, slack: f64) -> Result<Piece, PartsError> {
        let Content::Simplified(mesh) = &mut piece.content else { return Ok(piece) };
        let mut target = self.target;
        if let Some(error_m) = &mut target.error_m {
            let left = (*error_m - piece.error_m) * share;
            // Nothing to be spent, but for a difference of rounding.
            if left <= 1e-9 * *error_m {
                return Ok(piece);
            }
            *error_m = left;
        }
        if let Some(triangles) = &mut target.triangles {
            let [_, all] = self.store.totals();
            let part = piece.stored as f64 / all.max(1) as f64;
            *triangles = (*triangles as f64 * part * slack).floor() as usize;
        }
        let (simple, error_m) = simplify_placed(mesh, self.place, target, true)?;
        piece.is_done = simple.triangles.len() as f64 > MOST * mesh.triangles.len() as f64;
        piece.vertices = simple.vertices.len() as u64;
        piece.triangles = simple.triangles.len() as u64;
        piece.error_m += error_m;
        *mesh = simple;
        Ok(piece)
    }
}

impl Piece {
    fn clone_without_content(&self) -> Self {
        let content = Content::Stored(Vec::new());
        Self { content, rectangle: self.rectangle.clone(), ..*self }
    }
}

/// The way through the city.
struct Walk<'a, E> {
    /// Pieces that may still be joined, in their order.
    pending: Vec<Piece>,
    /// Pieces that were given.
    count: u32,
    give: &'a mut dyn FnMut(u32, bool, Piece) -> Result<(), E>,
}
