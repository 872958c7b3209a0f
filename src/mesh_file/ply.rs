//! PLY, binary little-endian.

use super::{MeshFileError, MeshGeoreference, check, comments, put, texture};
use sat3d_model::Image8;
use sat3d_model::mesh::Mesh;
use std::io::Write;

/// Most vertices: readers take indices as signed 32-bit integers.
const MOST: u64 = i32::MAX as u64;

/// Writes a mesh as binary PLY: float positions, `uchar` colours where there are any (a texture's at the
/// vertices), triangles as lists of three `int`.
///
/// # Errors
/// Those of [`encode`](super::encode).
pub fn write_ply(
    mesh: &Mesh,
    georeference: Option<&MeshGeoreference>,
    texture: Option<&Image8>,
    out: &mut impl Write,
) -> Result<(), MeshFileError> {
    check(mesh, georeference)?;
    limit(mesh.vertices.len() as u64)?;
    let places = mesh.texture_coordinates.as_deref();
    let texture = match (places, texture) {
        (Some(places), Some(image)) => Some((places, image)),
        (Some(_), None) if mesh.colors.is_none() => return Err(MeshFileError::NoTexture),
        _ => None,
    };
    let color = |index: usize| match (&mesh.colors, texture) {
        (Some(colors), _) => Some(colors[index]),
        (None, Some((places, image))) => Some(texture::color(image, places[index])),
        (None, None) => None,
    };
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    for comment in comments(mesh, georeference) {
        header += &format!("comment {comment}\n");
    }
    header += &format!("element vertex {}\n", mesh.vertices.len());
    header += "property float x\nproperty float y\nproperty float z\n";
    if color(0).is_some() {
        header += "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    }
    header += &format!("element face {}\n", mesh.triangles.len());
    header += "property list uchar int vertex_indices\nend_header\n";
    out.write_all(header.as_bytes())?;
    let mut first = 0;
    let mut buffer = Vec::new();
    for group in mesh.vertices.chunks(super::GROUP) {
        buffer.clear();
        for (index, vertex) in (first..).zip(group) {
            buffer.extend(vertex.iter().flat_map(|value| value.to_le_bytes()));
            buffer.extend(color(index).into_iter().flatten());
        }
        out.write_all(&buffer)?;
        first += group.len();
    }
    put(out, &mesh.triangles, |corners, buffer| {
        buffer.push(3);
        buffer.extend(corners.iter().flat_map(|corner| corner.to_le_bytes()));
    })?;
    Ok(())
}

fn limit(vertices: u64) -> Result<(), MeshFileError> {
    if vertices <= MOST {
        return Ok(());
    }
    Err(MeshFileError::TooLarge {
        format: "ply",
        what: "vertices",
        found: vertices,
        most: MOST,
        instead: "write an obj",
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_is_the_readers() {
        assert!(limit(i32::MAX as u64).is_ok());
        assert!(matches!(limit(1 << 31), Err(MeshFileError::TooLarge { format: "ply", .. })));
    }
}
