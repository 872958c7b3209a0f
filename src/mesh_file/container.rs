//! What every binary glTF is made of: buffer views, accessors, and the container around them.

use super::MeshFileError;
use serde_json::{Value, json};
use std::io::Write;

/// 32-bit floats.
pub(crate) const FLOAT: u32 = 5126;
/// 16-bit whole numbers.
pub(crate) const UNSIGNED_SHORT: u32 = 5123;
/// 32-bit whole numbers.
pub(crate) const UNSIGNED_INT: u32 = 5125;
/// A buffer view's target: attributes of vertices.
pub(crate) const VERTICES: u32 = 34962;
/// A buffer view's target: corners of triangles.
pub(crate) const INDICES: u32 = 34963;

/// The layout of the one buffer of a binary glTF: views in the order in which they are written, each from a
/// multiple of 4 bytes on.
#[derive(Default)]
pub(crate) struct Layout {
    pub(crate) views: Vec<Value>,
    pub(crate) accessors: Vec<Value>,
    /// Bytes of the buffer.
    pub(crate) length: u64,
}

impl Layout {
    /// A further view; its number.
    pub(crate) fn view(&mut self, length: u64, target: Option<u32>) -> usize {
        let mut view = json!({ "buffer": 0, "byteOffset": self.length, "byteLength": length });
        if let Some(target) = target {
            view["target"] = target.into();
        }
        self.length += length.next_multiple_of(4);
        self.views.push(view);
        self.views.len() - 1
    }

    /// An accessor of a view; its number.
    pub(crate) fn accessor(
        &mut self,
        view: usize,
        component: u32,
        count: u64,
        kind: &str,
        bounds: Option<[[f32; 3]; 2]>,
    ) -> usize {
        let mut accessor = json!({
            "bufferView": view, "componentType": component, "count": count, "type": kind,
        });
        if let Some([low, high]) = bounds {
            accessor["min"] = json!(low);
            accessor["max"] = json!(high);
        }
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    /// Writes all that stands before the buffer's first byte: header, document, header of the buffer.
    ///
    /// # Errors
    /// [`MeshFileError::TooLarge`] above 4 GiB, [`MeshFileError::Io`].
    pub(crate) fn start(
        &self,
        document: &Value,
        out: &mut impl Write,
    ) -> Result<(), MeshFileError> {
        let mut json = document.to_string().into_bytes();
        json.resize(json.len().next_multiple_of(4), b' ');
        let (json_length, length) = (json.len() as u64, self.length);
        let total = total(json_length, length)?;
        // Both parts fit if their sum does.
        let (json_length, length) = (json_length as u32, length as u32);
        out.write_all(b"glTF")?;
        out.write_all(&[2, total, json_length].map(u32::to_le_bytes).concat())?;
        out.write_all(b"JSON")?;
        out.write_all(&json)?;
        out.write_all(&length.to_le_bytes())?;
        out.write_all(b"BIN\0")?;
        Ok(())
    }
}

/// Smallest and largest coordinates.
pub(crate) fn bounds(vertices: impl Iterator<Item = [f32; 3]>) -> [[f32; 3]; 2] {
    vertices.fold([[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]], |[low, high], vertex| {
        [[0, 1, 2].map(|k| low[k].min(vertex[k])), [0, 1, 2].map(|k| high[k].max(vertex[k]))]
    })
}

/// Bytes of the whole file; glTF states them in 32 bits.
fn total(json: u64, binary: u64) -> Result<u32, MeshFileError> {
    let found = 12 + 8 + json + 8 + binary;
    u32::try_from(found).map_err(|_| MeshFileError::TooLarge {
        format: "glb",
        what: "bytes",
        found,
        most: u32::MAX.into(),
        instead: "write a ply",
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_gibibytes_are_the_limit() {
        let most = u64::from(u32::MAX) - 28;
        assert_eq!(total(1000, most - 1000).ok(), Some(u32::MAX));
        let error = total(1000, most - 999).expect_err("too large");
        assert!(error.to_string().contains("4294967296 bytes"), "{error}");
    }
}
