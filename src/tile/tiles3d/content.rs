//! A tile's file: binary glTF with one mesh and its picture, shown without light.

use super::texture::Texture;
use crate::mesh_file::MeshFileError;
use crate::mesh_file::container::{
    FLOAT, INDICES, Layout, UNSIGNED_INT, UNSIGNED_SHORT, VERTICES, bounds,
};
use crate::tile::surface::MeshTile;
use serde_json::json;

/// What a tile's file is made of.
pub(super) struct Content<'a> {
    /// Vertices in grid coordinates, and triangles.
    pub(super) mesh: &'a MeshTile,
    /// East, north and up of the vertices, metres.
    pub(super) metres: &'a [[f64; 3]],
    /// The place from which the file counts.
    pub(super) middle: [f64; 3],
    /// The tile's picture.
    pub(super) texture: &'a Texture,
    /// Model pixels: the picture's north-west corner.
    pub(super) corner: [u32; 2],
    /// Model pixels per pixel of the picture.
    pub(super) texel: u32,
}

impl Content<'_> {
    /// The file.
    ///
    /// Positions count from the tile's middle, which is the translation of the one node. glTF has y up: numbers
    /// are x east, y up, z south, as 3D Tiles expects of its contents. Texture coordinates are the share of the
    /// picture in 16 bits; what lies beyond its edge (half a pixel at the city's border) has the edge's colour.
    ///
    /// # Errors
    /// [`MeshFileError::TooLarge`], [`MeshFileError::Texture`].
    pub(super) fn encode(&self) -> Result<Vec<u8>, MeshFileError> {
        let turn = |[east, north, up]: [f64; 3]| [east, up, -north];
        let local = |at: &[f64; 3]| {
            // Exact: both are multiples of the step, and 24 bits hold the difference.
            let d: [f64; 3] = std::array::from_fn(|k| at[k] - self.middle[k]);
            // Adding 0 makes -0 a plain 0.
            turn(d).map(|value| value as f32 + 0.0)
        };
        let positions: Vec<[f32; 3]> = self.metres.iter().map(local).collect();
        let triangles: Vec<[u32; 3]> = self
            .mesh
            .triangles
            .iter()
            .copied()
            .filter(|corners| {
                let [a, b, c] = corners.map(|corner| positions[corner as usize]);
                a != b && b != c && c != a
            })
            .collect();
        let [width, height] = self.texture.size;
        let jpeg = self.texture.jpeg().map_err(|error| MeshFileError::Texture {
            width: width as usize,
            height: height as usize,
            channels: 3,
            reason: error.to_string(),
        })?;

        let mut layout = Layout::default();
        let (count, corners) = (positions.len() as u64, 3 * triangles.len() as u64);
        // The largest number of 16 bits is no index.
        let short = count < u64::from(u16::MAX);
        let view = layout.view(12 * count, Some(VERTICES));
        let limits = Some(bounds(positions.iter().copied()));
        let position = layout.accessor(view, FLOAT, count, "VEC3", limits);
        let view = layout.view(4 * count, Some(VERTICES));
        let place = layout.accessor(view, UNSIGNED_SHORT, count, "VEC2", None);
        layout.accessors[place]["normalized"] = true.into();
        let (component, bytes) = if short { (UNSIGNED_SHORT, 2) } else { (UNSIGNED_INT, 4) };
        let view = layout.view(bytes * corners, Some(INDICES));
        let indices = layout.accessor(view, component, corners, "SCALAR", None);
        let image = layout.view(jpeg.len() as u64, None);
        let document = json!({
            "asset": { "version": "2.0", "generator": "sat3d" },
            "extensionsUsed": ["KHR_materials_unlit"],
            "scene": 0,
            "scenes": [{ "nodes": [0] }],
            "nodes": [{ "mesh": 0, "translation": turn(self.middle).map(|value| value + 0.0) }],
            "meshes": [{ "primitives": [{
                "attributes": { "POSITION": position, "TEXCOORD_0": place },
                "indices": indices,
                "material": 0,
            }] }],
            "materials": [{
                "pbrMetallicRoughness": {
                    "baseColorTexture": { "index": 0 },
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "extensions": { "KHR_materials_unlit": {} },
            }],
            "textures": [{ "sampler": 0, "source": 0 }],
            "images": [{ "bufferView": image, "mimeType": "image/jpeg" }],
            // Linear, from smaller copies where it is far away, and no repetition beyond the edge.
            "samplers": [{ "magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071 }],
            "accessors": layout.accessors,
            "bufferViews": layout.views,
            "buffers": [{ "byteLength": layout.length }],
        });

        let mut out = Vec::new();
        layout.start(&document, &mut out)?;
        let start = out.len();
        out.extend(positions.iter().flatten().flat_map(|value| value.to_le_bytes()));
        for vertex in &self.mesh.vertices {
            let corner_and_size = self.corner.iter().zip(&self.texture.size);
            for (at, (corner, size)) in vertex.iter().zip(corner_and_size) {
                let cover = f64::from(*size) * f64::from(self.texel);
                let share = (at - f64::from(*corner)) / cover;
                let share = (share.clamp(0.0, 1.0) * f64::from(u16::MAX)).round() as u16;
                out.extend(share.to_le_bytes());
            }
        }
        for corner in triangles.iter().flatten() {
            // Below 65535 where they are short.
            if short {
                out.extend((*corner as u16).to_le_bytes());
            } else {
                out.extend(corner.to_le_bytes());
            }
        }
        out.resize(start + (out.len() - start).next_multiple_of(4), 0);
        out.extend(&jpeg);
        out.resize(start + (out.len() - start).next_multiple_of(4), 0);
        Ok(out)
    }
}
