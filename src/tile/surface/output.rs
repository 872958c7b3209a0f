//! The city's surface as mesh files: one, or several where one would be too large.

use super::older::older;
use super::parts::{Content, Parts, PartsError, Piece};
use super::simplify::Target;
use super::store::SurfaceStore;
use super::weld::Welder;
use super::{MeshTile, TILE};
use crate::batch::{AtomicFile, sync_folder};
use crate::mesh_file::{
    MeshFileError, MeshFormat, MeshGeoreference, companions, texture_png, write_glb,
    write_material, write_obj, write_ply,
};
use crate::plan::runs;
use crate::tile::frame::LocalFrame;
use crate::tile::slabs::Slabs;
use rayon::prelude::*;
use sat3d_model::Image8;
use sat3d_model::mesh::{Mesh, MeshFrame};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::{self, BufWriter, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Bytes of the largest file: what programs with signed 32-bit lengths still open.
pub const PART_BYTES: u64 = i32::MAX as u64;

/// Pixels along a side of the largest texture: what graphics cards surely take.
pub const TEXTURE_SIDE: u32 = 8192;

/// What colours the mesh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CityMeshColour {
    /// Nothing.
    None,
    /// The picture at model resolution, at each vertex.
    #[default]
    Vertices,
    /// The picture at model resolution, as a texture. PLY has none: its vertices are coloured.
    Texture,
}

/// How the mesh is written.
#[derive(Clone, Debug, PartialEq)]
pub struct CityMeshOptions {
    /// What colours it.
    pub colour: CityMeshColour,
    /// How far it is simplified.
    pub target: Target,
    /// Density of the surface, for the message of an empty one.
    pub isovalue: f64,
    /// Metres of the mesh per metre of height by the model's true proportion, noted in the files.
    pub vertical_exaggeration: f64,
    /// Bytes of the largest file ([`PART_BYTES`]).
    pub part_bytes: u64,
    /// Pixels along a side of the largest texture ([`TEXTURE_SIDE`]).
    pub texture_side: u32,
}

impl Default for CityMeshOptions {
    fn default() -> Self {
        Self {
            colour: CityMeshColour::default(),
            target: Target::default(),
            isovalue: 5.0,
            vertical_exaggeration: 1.0,
            part_bytes: PART_BYTES,
            texture_side: TEXTURE_SIDE,
        }
    }
}

/// A file that was written.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct WrittenFile {
    /// Its name, in the folder of the mesh.
    pub name: String,
    /// Its size.
    pub bytes: u64,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MeshSummary {
    /// The files, in the order of the parts.
    pub files: Vec<WrittenFile>,
    /// Vertices of all parts.
    pub vertices: u64,
    /// Triangles of all parts.
    pub triangles: u64,
    /// Number of parts.
    pub parts: u32,
    /// Largest distance to the surface before simplification, metres; 0 without.
    pub error_m: f64,
}

/// Why no mesh is written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CityMeshError {
    /// Tiles are not read or not simplified.
    #[error(transparent)]
    Parts(#[from] PartsError),
    /// The name says no format.
    #[error("{}: {reason}", path.display())]
    Format {
        /// The file asked for.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// There is no triangle.
    #[error(
        "the city's surface is empty: no density reaches the isovalue {isovalue}; try a lower --isovalue"
    )]
    Empty {
        /// The isovalue.
        isovalue: f64,
    },
    /// One tile is over the limit.
    #[error(
        "a single tile of {triangles} triangles takes {bytes} bytes, and a part holds {most}: simplify with --error"
    )]
    Tile {
        /// Its triangles.
        triangles: u64,
        /// Bytes that it takes.
        bytes: u64,
        /// The limit.
        most: u64,
    },
    /// 32-bit coordinates would merge vertices.
    #[error(
        "{merged} vertices fall together in 32-bit coordinates, whose step is {step_m} m at {extent_m} m from the city's centre: simplify with --error, or write --tiles3d, where each tile has its own origin"
    )]
    TooFine {
        /// Vertices at a place that another one takes.
        merged: usize,
        /// Distance of neighbouring 32-bit numbers there, metres.
        step_m: f64,
        /// Largest coordinate, metres.
        extent_m: f64,
    },
    /// A mesh file cannot hold it.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why.
        source: MeshFileError,
    },
    /// Reading colours or writing failed.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
}

/// Writes the surface to `out`, whose ending says the format: `.glb`, `.ply` or `.obj` (with `.mtl` and
/// `.png` for a texture). Where one file would pass the limits there are several, `<name>_1.glb`,
/// `<name>_2.glb`, ... quarter by quarter: north-west, north-east, south-west, south-east, and so within each
/// ([`Parts`]). They have one origin, and the vertices on their common sides have the same bits. The
/// memory taken is that of the largest part. All files appear when all are complete; then those of an earlier run
/// into other parts are removed. `progress` is told how many
/// more tiles are done.
///
/// # Errors
/// [`CityMeshError`].
pub fn write_mesh(
    slabs: &Slabs<'_>,
    frame: &LocalFrame,
    options: &CityMeshOptions,
    out: &Path,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<MeshSummary, CityMeshError> {
    let store = SurfaceStore::open(slabs).map_err(PartsError::from)?;
    if store.totals()[1] == 0 {
        return Err(CityMeshError::Empty { isovalue: options.isovalue });
    }
    runs("mesh");
    if options.target != Target::default() {
        runs("simplify");
    }
    if options.colour != CityMeshColour::None {
        runs("colour");
    }
    let mut writer = Writer::new(&store, frame, options, out, progress)?;
    let place = |point: [f64; 3]| frame.place(point);
    let limits = Limits { format: writer.format, colour: writer.colour, options };
    let fits = |piece: &Piece| limits.fit(piece);
    let parts =
        Parts { store: &store, place: &place, target: options.target, fits: &fits, progress };
    writer.summary.parts = parts.each(|number, only, piece| {
        let bytes = limits.bytes(&piece);
        if bytes > options.part_bytes {
            let (triangles, most) = (piece.triangles, options.part_bytes);
            return Err(CityMeshError::Tile { triangles, bytes, most });
        }
        writer.write(if only { None } else { Some(number) }, piece)
    })?;
    writer.finish()
}

/// What fits into one file.
struct Limits<'a> {
    format: MeshFormat,
    colour: CityMeshColour,
    options: &'a CityMeshOptions,
}

impl Limits<'_> {
    /// At least the bytes of the file: exact but for the vertices that welding saves and for text.
    fn bytes(&self, piece: &Piece) -> u64 {
        let [width, height] = piece.rectangle.clone().map(|range| range.len() as u64);
        let textured = self.colour == CityMeshColour::Texture;
        let coloured = self.colour == CityMeshColour::Vertices;
        // A PNG is at most its pixels, a byte per row and a few per block.
        let png = if textured { (3 * width + 1) * height * 1001 / 1000 + 1024 } else { 0 };
        let (vertex, triangle, rest) = match self.format {
            // Normals of a mesh without colours, colours and texture coordinates: 12, 8 and 8 bytes.
            MeshFormat::Glb => (12 + if textured || coloured { 8 } else { 12 }, 12, 4096 + png),
            MeshFormat::Ply => (if coloured { 15 } else { 12 }, 13, 4096),
            // Lines of numbers of up to 14, 8 and (indices) 10 digits.
            MeshFormat::Obj => {
                (48 + if coloured { 27 } else { 0 } + if textured { 48 } else { 0 }, 72, 4096)
            }
        };
        rest + piece.vertices * vertex + piece.triangles * triangle
    }

    fn fit(&self, piece: &Piece) -> bool {
        let side = piece.rectangle.iter().map(Range::len).max().unwrap_or(0);
        let textured = self.colour == CityMeshColour::Texture;
        self.bytes(piece) <= self.options.part_bytes
            && (!textured || side <= self.options.texture_side as usize)
    }
}

struct Writer<'a> {
    store: &'a SurfaceStore<'a>,
    frame: &'a LocalFrame,
    colour: CityMeshColour,
    georeference: Option<MeshGeoreference>,
    format: MeshFormat,
    folder: PathBuf,
    stem: String,
    progress: &'a (dyn Fn(u64) + Sync),
    files: Vec<(AtomicFile, WrittenFile)>,
    summary: MeshSummary,
}

impl<'a> Writer<'a> {
    fn new(
        store: &'a SurfaceStore<'a>,
        frame: &'a LocalFrame,
        options: &CityMeshOptions,
        out: &Path,
        progress: &'a (dyn Fn(u64) + Sync),
    ) -> Result<Self, CityMeshError> {
        let wrong = |reason: String| CityMeshError::Format { path: out.to_owned(), reason };
        let [stem, ending] = [out.file_stem(), out.extension()].map(|part| part?.to_str());
        let (Some(stem), Some(ending)) = (stem, ending) else {
            return Err(wrong("a mesh file ends in .glb, .ply or .obj".to_owned()));
        };
        let format: MeshFormat = ending.parse().map_err(wrong)?;
        let colour = match (options.colour, format) {
            (CityMeshColour::Texture, MeshFormat::Ply) => CityMeshColour::Vertices,
            (colour, _) => colour,
        };
        let vertical_exaggeration = options.vertical_exaggeration;
        let georeference =
            frame.origin().map(|origin| MeshGeoreference { origin, vertical_exaggeration });
        let folder = match out.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        let summary =
            MeshSummary { files: Vec::new(), vertices: 0, triangles: 0, parts: 0, error_m: 0.0 };
        Ok(Self {
            store,
            frame,
            colour,
            georeference,
            format,
            folder: folder.to_owned(),
            stem: stem.to_owned(),
            progress,
            files: Vec::new(),
            summary,
        })
    }

    /// Writes a piece, numbered if there are several.
    fn write(&mut self, number: Option<u32>, piece: Piece) -> Result<(), CityMeshError> {
        let stem = match number {
            None => self.stem.clone(),
            Some(number) => format!("{}_{number}", self.stem),
        };
        self.summary.error_m = self.summary.error_m.max(piece.error_m);
        let rectangle = piece.rectangle.clone();
        let mesh = self.assemble(piece)?;
        self.summary.vertices += mesh.vertices.len() as u64;
        self.summary.triangles += mesh.triangles.len() as u64;
        let texture = match self.colour {
            CityMeshColour::Texture => Some(self.texture(rectangle)?),
            _ => None,
        };
        let name = format!("{stem}.{}", self.format.extension());
        let (format, place) = (self.format, self.georeference);
        let texture = texture.as_ref();
        let [material, picture] = companions(&stem);
        self.file(name, |out| match format {
            MeshFormat::Glb => write_glb(&mesh, place.as_ref(), texture, out),
            MeshFormat::Ply => write_ply(&mesh, place.as_ref(), texture, out),
            MeshFormat::Obj => {
                let material = texture.map(|_| &*material);
                write_obj(&mesh, place.as_ref(), material, out)
            }
        })?;
        if let (MeshFormat::Obj, Some(texture)) = (format, texture) {
            let named = picture.clone();
            self.file(material, |out| Ok(write_material(&named, out)?))?;
            self.file(picture, |out| Ok(out.write_all(&texture_png(texture)?)?))?;
        }
        Ok(())
    }

    /// Writes a file beside its place.
    fn file(
        &mut self,
        name: String,
        write: impl FnOnce(&mut BufWriter<&mut std::fs::File>) -> Result<(), MeshFileError>,
    ) -> Result<(), CityMeshError> {
        let path = self.folder.join(&name);
        let failed = |source| CityMeshError::Io { path: path.clone(), source };
        let mut file = AtomicFile::create(&path).map_err(failed)?;
        let mut out = BufWriter::with_capacity(1 << 20, file.file());
        write(&mut out).map_err(|source| match source {
            MeshFileError::Io(source) => failed(source),
            source => CityMeshError::File { path: path.clone(), source },
        })?;
        out.flush().map_err(failed)?;
        drop(out);
        let bytes = file.file().metadata().map_err(failed)?.len();
        self.files.push((file, WrittenFile { name, bytes }));
        Ok(())
    }

    /// All files take their places; those of an earlier run into other parts go.
    fn finish(mut self) -> Result<MeshSummary, CityMeshError> {
        for (file, written) in self.files {
            let path = self.folder.join(&written.name);
            file.commit().map_err(|source| CityMeshError::Io { path, source })?;
            self.summary.files.push(written);
        }
        let name = format!("{}.{}", self.stem, self.format.extension());
        let is_whole = self.summary.files.iter().any(|file| file.name == name);
        let parts = if is_whole { None } else { Some(self.summary.parts) };
        for path in older(&self.folder, &self.stem, self.format, parts) {
            std::fs::remove_file(&path).map_err(|source| CityMeshError::Io { path, source })?;
        }
        let path = self.folder.clone();
        sync_folder(&self.folder).map_err(|source| CityMeshError::Io { path, source })?;
        Ok(self.summary)
    }

    /// The piece in metres, with its colours.
    fn assemble(&self, piece: Piece) -> Result<Mesh, CityMeshError> {
        let mut mesh = Mesh { frame: MeshFrame::EastNorthUp, ..Mesh::default() };
        match self.colour {
            CityMeshColour::None => {}
            CityMeshColour::Vertices => mesh.colors = Some(Vec::new()),
            CityMeshColour::Texture => mesh.texture_coordinates = Some(Vec::new()),
        }
        let rectangle = piece.rectangle;
        match piece.content {
            Content::Simplified(tile) => {
                self.add(&mut mesh, &rectangle, tile.vertices, tile.triangles)?;
            }
            Content::Stored(tiles) => {
                let mut welder = Welder::default();
                for index in tiles {
                    let tile = self.store.read_tile(index).map_err(PartsError::from)?;
                    let numbers = welder.number(&tile);
                    let MeshTile { vertices, mut triangles } = tile;
                    for corner in triangles.iter_mut().flatten() {
                        *corner = numbers[*corner as usize].0;
                    }
                    let new = vertices.into_iter().zip(&numbers).filter(|(_, (_, new))| *new);
                    let new = new.map(|(vertex, _)| vertex).collect();
                    self.add(&mut mesh, &rectangle, new, triangles)?;
                    (self.progress)(1);
                }
            }
        }
        check_positions(&mesh.vertices)?;
        Ok(mesh)
    }

    fn add(
        &self,
        mesh: &mut Mesh,
        rectangle: &[Range<u32>; 2],
        vertices: Vec<[f64; 3]>,
        triangles: Vec<[u32; 3]>,
    ) -> Result<(), CityMeshError> {
        if let Some(colours) = &mut mesh.colors {
            colours.extend(self.colours(&vertices)?);
        }
        if let Some(places) = &mut mesh.texture_coordinates {
            let share = |value: f64, range: &Range<u32>| {
                let share = (value - f64::from(range.start)) / range.len() as f64;
                share.clamp(0.0, 1.0) as f32
            };
            let [columns, rows] = rectangle;
            places.extend(vertices.iter().map(|[x, y, _]| [share(*x, columns), share(*y, rows)]));
        }
        let placed = vertices.into_par_iter().map(|v| self.frame.place(v).map(|v| v as f32));
        mesh.vertices.par_extend(placed);
        mesh.triangles.extend(triangles);
        Ok(())
    }

    /// Colours of vertices, between the four nearest pixel centres; read tile by tile.
    fn colours(&self, vertices: &[[f64; 3]]) -> Result<Vec<[u8; 3]>, CityMeshError> {
        let size = self.store.slabs().city.size;
        let tile = |value: f64, size: u32| (value.clamp(0.0, f64::from(size - 1)) as u32) / TILE;
        let mut tiles: BTreeMap<[u32; 2], Vec<u32>> = BTreeMap::new();
        for (index, [x, y, _]) in (0..).zip(vertices) {
            tiles.entry([tile(*y, size[1]), tile(*x, size[0])]).or_default().push(index);
        }
        let mut colours = vec![[0; 3]; vertices.len()];
        for ([row, column], indices) in tiles {
            // With a pixel more on each side.
            let range = |tile: u32, size: u32| {
                (tile * TILE).saturating_sub(1)..((tile + 1) * TILE + 1).min(size)
            };
            let [columns, rows] = [range(column, size[0]), range(row, size[1])];
            let image = self.texture([columns.clone(), rows.clone()])?;
            let found: Vec<[u8; 3]> = indices
                .par_iter()
                .map(|index| {
                    let [x, y, _] = vertices[*index as usize];
                    bilinear(&image, x - f64::from(columns.start), y - f64::from(rows.start))
                })
                .collect();
            for (index, colour) in indices.into_iter().zip(found) {
                colours[index as usize] = colour;
            }
        }
        Ok(colours)
    }

    /// The picture of a rectangle.
    fn texture(&self, [columns, rows]: [Range<u32>; 2]) -> Result<Image8, CityMeshError> {
        let (width, height) = (columns.len(), rows.len());
        let slabs = self.store.slabs();
        let failed = |source| CityMeshError::Io { path: slabs.out.to_owned(), source };
        let data = slabs.colours([columns, rows]).map_err(failed)?;
        Ok(Image8 { width, height, channels: 3, data })
    }
}

/// Red, green and blue of a picture at pixel coordinates (the centre of pixel 0 is 1/2).
fn bilinear(image: &Image8, x: f64, y: f64) -> [u8; 3] {
    let taps = |value: f64, size: usize| {
        let at = (value - 0.5).clamp(0.0, (size - 1) as f64);
        let first = at as usize;
        (first, (first + 1).min(size - 1), at - first as f64)
    };
    let ((x0, x1, right), (y0, y1, down)) = (taps(x, image.width), taps(y, image.height));
    [0, 1, 2].map(|k| {
        let at = |x: usize, y: usize| f64::from(image.data[(y * image.width + x) * 3 + k]);
        let top = at(x0, y0) * (1.0 - right) + at(x1, y0) * right;
        let bottom = at(x0, y1) * (1.0 - right) + at(x1, y1) * right;
        (top * (1.0 - down) + bottom * down).round() as u8
    })
}

/// Refuses positions that rounding has merged.
fn check_positions(vertices: &[[f32; 3]]) -> Result<(), CityMeshError> {
    let mut sorted: Vec<[u32; 3]> =
        vertices.iter().map(|vertex| vertex.map(|value| (value + 0.0).to_bits())).collect();
    sorted.par_sort_unstable();
    let merged = sorted.windows(2).filter(|pair| pair[0] == pair[1]).count();
    if merged == 0 {
        return Ok(());
    }
    let extent = vertices.iter().flatten().fold(0.0_f32, |most, value| most.max(value.abs()));
    Err(CityMeshError::TooFine {
        merged,
        step_m: f64::from(extent.next_up()) - f64::from(extent),
        extent_m: extent.into(),
    })
}
