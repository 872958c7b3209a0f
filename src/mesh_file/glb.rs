//! Binary glTF 2.0: one mesh, one material, everything inside the file.
//!
//! The JSON is made with `serde_json`, which is here anyway: the document is a dozen small objects whose
//! shape never varies, the Khronos validator checks it in the tests, and typed structures would be a
//! dependency of three more crates.

use super::container::{FLOAT, INDICES, Layout, UNSIGNED_INT, UNSIGNED_SHORT, VERTICES, bounds};
use super::{MeshFileError, MeshGeoreference, check, frame_name, put, texture};
use sat3d_model::Image8;
use sat3d_model::mesh::{Mesh, MeshFrame};
use serde_json::{Map, Value, json};
use std::io::Write;

/// Writes a mesh as binary glTF.
///
/// glTF has y up and states positions in metres, so an east-north-up mesh is written as x east, y up, z
/// south: the numbers themselves are exchanged, no node turns them, because not every reader looks at
/// nodes. Vertex colours are linear in glTF: image values are taken through the sRGB curve and stored in
/// 16 bits, since 8 would merge the dark ones. What has colours or a texture is shown without light (the
/// image has its own; `KHR_materials_unlit`), anything else is matt and grey, with normals.
///
/// The scene's `extras` hold `frame`, `axes`, and with a georeference `origin_longitude_deg`,
/// `origin_latitude_deg` (WGS 84) and `vertical_exaggeration`.
///
/// # Errors
/// Those of [`encode`](super::encode).
pub fn write_glb(
    mesh: &Mesh,
    georeference: Option<&MeshGeoreference>,
    texture: Option<&Image8>,
    out: &mut impl Write,
) -> Result<(), MeshFileError> {
    check(mesh, georeference)?;
    let picture = match (&mesh.texture_coordinates, texture) {
        (Some(_), Some(image)) => Some(texture::png(image)?),
        (Some(_), None) => return Err(MeshFileError::NoTexture),
        (None, _) => None,
    };
    let places = mesh.texture_coordinates.as_deref();
    let colors = mesh.colors.as_deref().filter(|_| places.is_none());
    let turn = |[x, y, z]: [f32; 3]| match mesh.frame {
        MeshFrame::EastNorthUp => [x, z, -y],
        MeshFrame::Reference => [x, y, z],
    };
    let normals = (places.is_none() && colors.is_none()).then(|| normals(mesh));

    let count = mesh.vertices.len() as u64;
    let mut layout = Layout::default();
    let mut attributes = Map::new();
    let positions = layout.view(12 * count, Some(VERTICES));
    let [low, high] = bounds(mesh.vertices.iter().map(|vertex| turn(*vertex)));
    let position = layout.accessor(positions, FLOAT, count, "VEC3", Some([low, high]));
    attributes.insert("POSITION".into(), position.into());
    if normals.is_some() {
        let view = layout.view(12 * count, Some(VERTICES));
        let normal = layout.accessor(view, FLOAT, count, "VEC3", None);
        attributes.insert("NORMAL".into(), normal.into());
    }
    if colors.is_some() {
        let view = layout.view(8 * count, Some(VERTICES));
        let color = layout.accessor(view, UNSIGNED_SHORT, count, "VEC4", None);
        layout.accessors[color]["normalized"] = true.into();
        attributes.insert("COLOR_0".into(), color.into());
    }
    if places.is_some() {
        let view = layout.view(8 * count, Some(VERTICES));
        let place = layout.accessor(view, FLOAT, count, "VEC2", None);
        attributes.insert("TEXCOORD_0".into(), place.into());
    }
    let corners = 3 * mesh.triangles.len() as u64;
    let view = layout.view(4 * corners, Some(INDICES));
    let indices = layout.accessor(view, UNSIGNED_INT, corners, "SCALAR", None);
    let image = picture.as_ref().map(|png| layout.view(png.len() as u64, None));

    let json = json(&layout, attributes, indices, image, mesh, georeference);
    layout.start(&json, out)?;

    let floats = |values: &[f32], buffer: &mut Vec<u8>| {
        buffer.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    };
    put(out, &mesh.vertices, |vertex, buffer| floats(&turn(*vertex), buffer))?;
    if let Some(normals) = normals {
        put(out, &normals, |normal, buffer| floats(&turn(*normal), buffer))?;
    }
    if let Some(colors) = colors {
        let linear = linear_values();
        put(out, colors, |[r, g, b], buffer| {
            let [r, g, b] = [r, g, b].map(|value| linear[usize::from(*value)]);
            buffer.extend([r, g, b, u16::MAX].iter().flat_map(|value| value.to_le_bytes()));
        })?;
    }
    if let Some(places) = places {
        put(out, places, |place, buffer| floats(place, buffer))?;
    }
    put(out, &mesh.triangles, |corners, buffer| {
        buffer.extend(corners.iter().flat_map(|corner| corner.to_le_bytes()));
    })?;
    if let Some(png) = picture {
        out.write_all(&png)?;
        out.write_all(&[0; 3][..png.len().next_multiple_of(4) - png.len()])?;
    }
    Ok(())
}

fn json(
    layout: &Layout,
    attributes: Map<String, Value>,
    indices: usize,
    image: Option<usize>,
    mesh: &Mesh,
    georeference: Option<&MeshGeoreference>,
) -> Value {
    let axes = match mesh.frame {
        MeshFrame::EastNorthUp => "metres, x east, y up, z south",
        MeshFrame::Reference => super::axes(mesh.frame),
    };
    let mut extras = json!({ "frame": frame_name(mesh.frame), "axes": axes });
    if let Some(MeshGeoreference { origin, vertical_exaggeration }) = georeference {
        extras["origin_longitude_deg"] = json!(origin.lon_deg);
        extras["origin_latitude_deg"] = json!(origin.lat_deg);
        extras["origin_crs"] = json!("EPSG:4326");
        extras["vertical_exaggeration"] = json!(vertical_exaggeration);
    }
    let unlit = !attributes.contains_key("NORMAL");
    let mut material = json!({
        "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 1.0 },
    });
    let mut document = json!({
        "asset": { "version": "2.0", "generator": "sat3d" },
        "scene": 0,
        "scenes": [{ "nodes": [0], "extras": extras }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{
            "primitives": [{ "attributes": attributes, "indices": indices, "material": 0 }],
        }],
    });
    if unlit {
        document["extensionsUsed"] = json!(["KHR_materials_unlit"]);
        material["extensions"] = json!({ "KHR_materials_unlit": {} });
    } else {
        material["pbrMetallicRoughness"]["baseColorFactor"] = json!([0.6, 0.6, 0.6, 1.0]);
    }
    if let Some(view) = image {
        material["pbrMetallicRoughness"]["baseColorTexture"] = json!({ "index": 0 });
        document["textures"] = json!([{ "sampler": 0, "source": 0 }]);
        document["images"] = json!([{ "bufferView": view, "mimeType": "image/png" }]);
        // Linear, and no repetition beyond the image's edge.
        document["samplers"] = json!([{
            "magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071,
        }]);
    }
    document["materials"] = json!([material]);
    document["accessors"] = json!(layout.accessors);
    document["bufferViews"] = json!(layout.views);
    document["buffers"] = json!([{ "byteLength": layout.length }]);
    document
}

/// Unit normals of the vertices: the sum of their triangles' normals, by area.
fn normals(mesh: &Mesh) -> Vec<[f32; 3]> {
    let mut sums = vec![[0.0_f32; 3]; mesh.vertices.len()];
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|index| mesh.vertices[index as usize].map(f64::from));
        let (u, v) = ([0, 1, 2].map(|k| b[k] - a[k]), [0, 1, 2].map(|k| c[k] - a[k]));
        let normal =
            [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        for index in triangle {
            for (sum, part) in sums[*index as usize].iter_mut().zip(normal) {
                *sum += part as f32;
            }
        }
    }
    for sum in &mut sums {
        let wide = sum.map(f64::from);
        let length = wide.iter().map(|v| v * v).sum::<f64>().sqrt();
        // Normals that cancel leave none; glTF wants one.
        *sum = if length > 1e-30 && length.is_finite() {
            wide.map(|value| (value / length) as f32)
        } else {
            [0.0, 0.0, 1.0]
        };
    }
    sums
}

/// The linear light of each image value (IEC 61966-2-1), in 16 bits.
fn linear_values() -> [u16; 256] {
    std::array::from_fn(|value| {
        let value = value as f64 / 255.0;
        let linear =
            if value <= 0.040_45 { value / 12.92 } else { libm::pow((value + 0.055) / 1.055, 2.4) };
        (linear * 65535.0).round() as u16
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sixteen_bits_hold_every_image_value() {
        let linear = linear_values();
        assert_eq!((linear[0], linear[255]), (0, u16::MAX));
        for (value, linear) in linear.into_iter().enumerate() {
            let linear = f64::from(linear) / 65535.0;
            let back = if linear <= 0.003_130_8 {
                12.92 * linear
            } else {
                1.055 * libm::pow(linear, 1.0 / 2.4) - 0.055
            };
            assert_eq!((back * 255.0).round() as usize, value);
        }
    }
}
