//! Wavefront OBJ: text, with colours behind the coordinates or a material beside it.

use super::{MeshFileError, MeshGeoreference, check, comments, put};
use sat3d_model::mesh::Mesh;
use std::io::Write;

/// Name of the material.
const MATERIAL: &str = "satellite";

/// Writes a mesh as OBJ. Numbers are the shortest that read back as the same 32-bit floats. With a
/// material file's name, texture coordinates are written (OBJ has v upward); colours follow the coordinates
/// where the mesh has them.
///
/// # Errors
/// Those of [`encode`](super::encode).
pub fn write_obj(
    mesh: &Mesh,
    georeference: Option<&MeshGeoreference>,
    material_file: Option<&str>,
    out: &mut impl Write,
) -> Result<(), MeshFileError> {
    check(mesh, georeference)?;
    let mut header: String =
        comments(mesh, georeference).iter().map(|comment| format!("# {comment}\n")).collect();
    if let Some(name) = material_file {
        header += &format!("mtllib {name}\n");
    }
    out.write_all(header.as_bytes())?;
    let shares: Vec<String> = (0..=255_u32).map(share).collect();
    let mut first = 0;
    let mut buffer = Vec::new();
    for group in mesh.vertices.chunks(super::GROUP) {
        buffer.clear();
        for (index, [x, y, z]) in (first..).zip(group) {
            write!(buffer, "v {x} {y} {z}")?;
            if let Some(colors) = &mesh.colors {
                let [r, g, b] = colors[index].map(|value| &*shares[usize::from(value)]);
                write!(buffer, " {r} {g} {b}")?;
            }
            buffer.push(b'\n');
        }
        out.write_all(&buffer)?;
        first += group.len();
    }
    let textured = material_file.and(mesh.texture_coordinates.as_ref());
    if let Some(places) = textured {
        put(out, places, |[u, v], buffer| {
            // Writing to a vector does not fail.
            let _ = writeln!(buffer, "vt {u} {}", 1.0 - v);
        })?;
        out.write_all(format!("usemtl {MATERIAL}\n").as_bytes())?;
    }
    put(out, &mesh.triangles, |corners, buffer| {
        let [a, b, c] = corners.map(|corner| u64::from(corner) + 1);
        let _ = if textured.is_some() {
            writeln!(buffer, "f {a}/{a} {b}/{b} {c}/{c}")
        } else {
            writeln!(buffer, "f {a} {b} {c}")
        };
    })?;
    Ok(())
}

/// Writes the material of a textured OBJ: the image alone, without light.
///
/// # Errors
/// When writing fails.
pub fn write_material(texture_file: &str, out: &mut impl Write) -> std::io::Result<()> {
    write!(out, "newmtl {MATERIAL}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 0\nmap_Kd {texture_file}\n")
}

/// A colour value as a share of 1, so that it comes back whether a reader rounds it or cuts it off: six
/// digits, rounded up.
fn share(value: u32) -> String {
    let millionths = (value * 1_000_000).div_ceil(255);
    format!("{}.{:06}", millionths / 1_000_000, millionths % 1_000_000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_come_back_rounded_or_cut_off() {
        for value in 0..=255_u32 {
            for read in [share(value).parse::<f32>().map(f64::from), share(value).parse::<f64>()] {
                let read = read.expect("a number") * 255.0;
                assert!(read >= f64::from(value) && read < f64::from(value) + 0.01, "{value}");
            }
        }
    }
}
