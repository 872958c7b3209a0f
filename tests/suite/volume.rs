//! Density volumes, read by zarr-python, xarray and numpy.
//!
//! Set `SAT3D_TEST_PYTHON` to an interpreter that has them; without one the comparisons say that they were
//! skipped.

#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{python, run_python};
use proptest::prelude::*;
use sat3d::crs::CrsSpec;
use sat3d::footprint::Footprint;
use sat3d::grid::{ImageGrid, LonLat, PixelPoint};
use sat3d::model::render::{DensityGrid, Lattice};
use sat3d::raster::deflate::Compression;
use sat3d::volume::{
    Axes, Frame, VolumeDescription, VolumeError, ZarrVolume, coordinates_npz, npy, save_npy,
};
use std::collections::BTreeMap;
use std::path::Path;

/// The value of a point, different for each.
fn value([x, y, z]: [usize; 3]) -> f32 {
    x as f32 * 1e4 + y as f32 * 1e2 + z as f32 + 0.25
}

fn region(start: [usize; 3], size: [usize; 3], value: impl Fn([usize; 3]) -> f32) -> Vec<f32> {
    let mut values = Vec::new();
    for x in start[0]..start[0] + size[0] {
        for y in start[1]..start[1] + size[1] {
            for z in start[2]..start[2] + size[2] {
                values.push(value([x, y, z]));
            }
        }
    }
    values
}

fn axes([x, y, z]: [usize; 3]) -> Axes {
    let axis = |n: usize, sign: f64| (0..n).map(|i| sign * (i as f64 - 3.5)).collect();
    Axes { x: axis(x, 0.25), y: axis(y, -0.25), z: axis(z, 0.5) }
}

fn local(shape: [usize; 3], chunk: [usize; 3]) -> VolumeDescription {
    let frame = Frame::Local { origin: Some(LonLat { lon_deg: -122.33, lat_deg: 47.6 }) };
    let mut description = VolumeDescription::new(axes(shape), frame, [40.0, 40.0, 32.0]);
    description.chunk = chunk;
    description
}

/// All files of a folder.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().to_string_lossy().into_owned();
                found.insert(name, std::fs::read(path).unwrap());
            }
        }
    }
    found
}

const LOOK: &str = "
import sys, warnings, numpy as np, xarray, zarr
warnings.simplefilter('error')
path = sys.argv[1]
group = zarr.open_group(path, mode='r')
assert group.metadata.consolidated_metadata is not None
array = group['density']
assert array.metadata.zarr_format == 3 and array.metadata.dimension_names == ('x', 'y', 'z')
assert array.dtype == np.float32 and np.isnan(array.fill_value)
data = xarray.open_zarr(path)
assert data.density.dims == ('x', 'y', 'z'), data
values = data.density.values
assert np.array_equal(values, array[:], equal_nan=True)
";

#[test]
fn zarr_python_and_xarray_read_a_volume() {
    let test = "zarr_python_and_xarray_read_a_volume";
    let Some(python) = python(test, "zarr, xarray, numpy, dask") else { return };
    let folder = tempfile::tempdir().unwrap();
    let (shape, chunk) = ([21, 13, 9], [8, 5, 4]);
    let path = folder.path().join("v.zarr");
    let mut description = local(shape, chunk);
    description.attributes.insert("weights".into(), "abc".into());
    let mut volume = ZarrVolume::create(&path, description).unwrap();
    assert!(!path.exists(), "nothing stands there before it is finished");
    // Two regions that share chunks, and one that is written twice; the end along x is left out.
    volume.write_region([0, 0, 0], [11, 13, 9], &region([0, 0, 0], [11, 13, 9], |_| 7.0)).unwrap();
    volume.write_region([0, 0, 0], [11, 13, 9], &region([0, 0, 0], [11, 13, 9], value)).unwrap();
    let start = [11, 2, 1];
    let hole = |point: [usize; 3]| if point == [12, 5, 3] { f32::NAN } else { value(point) };
    volume.write_region(start, [7, 11, 8], &region(start, [7, 11, 8], hole)).unwrap();
    let back = volume.read_region([10, 0, 0], [11, 13, 9]).unwrap();
    volume.finish().unwrap();
    let raw: Vec<u8> = back.iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(folder.path().join("back"), raw).unwrap();
    let script = format!(
        "{LOOK}
x, y, z = np.mgrid[0:21, 0:13, 0:9]
expected = (x * 1e4 + y * 1e2 + z + 0.25).astype(np.float32)
expected[11:, :2] = np.nan
expected[11:, :, :1] = np.nan
expected[18:] = np.nan
expected[12, 5, 3] = np.nan
assert np.array_equal(values, expected, equal_nan=True)
back = np.fromfile(sys.argv[2], '<f4').reshape(11, 13, 9)
assert np.array_equal(back, expected[10:], equal_nan=True)
for name, step, count in [('x', 0.25, 21), ('y', -0.25, 13), ('z', 0.5, 9)]:
    assert np.array_equal(data[name].values, step * (np.arange(count) - 3.5)), name
    assert data[name].attrs['units'] == 'm'
assert data.z.attrs['positive'] == 'up'
assert data.attrs['weights'] == 'abc' and data.attrs['metres_per_unit'] == [40, 40, 32]
assert data.attrs['origin_latitude'] == 47.6
# A map, as users make one.
assert data.density.sel(x=0.125, method='nearest').max('z').shape == (13,)
"
    );
    run_python(python, &script, &[&path, &folder.path().join("back")]);
    assert!(!files(&path).contains_key("density/c/2/2/2/0"));
    let names: Vec<_> = files(&path).into_keys().collect();
    assert!(names.contains(&"density/c/0/0/0".to_owned()), "{names:?}");
    assert_eq!(names.iter().filter(|n| n.starts_with("density/c/")).count(), 3 * 3 * 3);
}

#[test]
fn a_volume_on_the_map_says_its_crs() {
    let test = "a_volume_on_the_map_says_its_crs";
    let Some(python) = python(test, "zarr, xarray, numpy, dask, pyproj") else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.zarr");
    let grid = ImageGrid::new(LonLat { lon_deg: -122.33, lat_deg: 47.6 }, 20, 640, 640).unwrap();
    let footprint = Footprint::of_grid(grid);
    let lattice = Lattice::pixels(16, 0.8);
    let axes = Axes::on_map(&lattice, &footprint, 0.8, 32.24).unwrap();
    let last = grid.mercator(PixelPoint { x: 620.0, y: 620.0 });
    assert!((axes.x[15] - last.x).abs() < 1e-6 && (axes.y[15] - last.y).abs() < 1e-6);
    let crs = CrsSpec::from_epsg(3857);
    let mut description = VolumeDescription::new(axes, Frame::Map(crs), [40.3, 40.3, 32.24]);
    description.compression = Compression::Stored;
    let mut volume = ZarrVolume::create(&path, description).unwrap();
    let shape = lattice.shape();
    volume.write_region([0; 3], shape, &region([0; 3], shape, value)).unwrap();
    volume.finish().unwrap();
    let script = format!(
        "{LOOK}
import pyproj
assert 'spatial_ref' in data.coords, data
assert 'spatial_ref' in [data.density.encoding.get('grid_mapping'), data.density.attrs.get('grid_mapping')]
assert pyproj.CRS.from_user_input(data.spatial_ref.attrs['spatial_ref']).to_epsg() == 3857
assert data.attrs['proj:code'] == 'EPSG:3857'
assert data.x.attrs['standard_name'] == 'projection_x_coordinate'
assert data.x.values[-1] > data.x.values[0] and data.y.values[-1] < data.y.values[0]
x, y, z = np.mgrid[0:16, 0:16, 0:20]
assert np.array_equal(values, (x * 1e4 + y * 1e2 + z + 0.25).astype(np.float32))
"
    );
    run_python(python, &script, &[&path]);
}

#[test]
fn numpy_reads_a_grid_and_its_coordinates() {
    let test = "numpy_reads_a_grid_and_its_coordinates";
    let folder = tempfile::tempdir().unwrap();
    let lattice =
        Lattice { x: vec![-0.5, 0.5], y: vec![-0.6, 0.0, 0.6], z: vec![0.0, 0.25, 0.5, 0.75] };
    let values = region([0; 3], [2, 3, 4], value);
    let grid = DensityGrid { lattice, values: values.clone() };
    let axes = Axes::local(&grid.lattice, [40.0, 20.0, 10.0]);
    assert_eq!(axes.x, [-20.0, 20.0]);
    // Above the bottom of the cube.
    assert_eq!(axes.z, [10.0, 12.5, 15.0, 17.5]);
    // y of the cube runs south; a float32 of 0.6 is not 0.6.
    assert!(
        (axes.y[0] - 12.0).abs() < 1e-5
            && axes.y[1].to_bits() == 0
            && (axes.y[2] + 12.0).abs() < 1e-5
    );
    let bytes = npy(&grid);
    let tail: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    assert!(bytes.starts_with(b"\x93NUMPY\x01\0") && bytes.ends_with(&tail));
    assert_eq!((bytes.len() - tail.len()) % 64, 0);
    let path = folder.path().join("grid.npy");
    let beside = save_npy(&path, &grid, &axes).unwrap();
    assert_eq!(std::fs::read(&beside).unwrap(), coordinates_npz(&axes));
    let wrong = Axes { x: vec![0.0], ..axes };
    assert!(matches!(save_npy(&path, &grid, &wrong), Err(VolumeError::Description { .. })));
    let Some(python) = python(test, "numpy") else { return };
    let script = "
import sys, numpy as np
grid = np.load(sys.argv[1])
x, y, z = np.mgrid[0:2, 0:3, 0:4]
assert grid.dtype == np.float32 and grid.flags.c_contiguous
assert np.array_equal(grid, (x * 1e4 + y * 1e2 + z + 0.25).astype(np.float32))
at = np.load(sys.argv[2])
assert at['x'].tolist() == [-20, 20] and at['z'].tolist() == [10, 12.5, 15, 17.5] and at['y'].shape == (3,)
";
    run_python(python, script, &[&path, &beside]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn what_is_written_in_pieces_is_what_is_written_at_once(
        shape in prop::array::uniform3(1_usize..14), chunk in prop::array::uniform3(1_usize..7),
        pieces in prop::collection::vec((prop::array::uniform3(0.0..1.0_f64), prop::array::uniform3(0.0..1.0_f64)), 1..5),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let mut expected = vec![f32::NAN; shape.iter().product()];
        let path = folder.path().join("pieces.zarr");
        let mut volume = ZarrVolume::create(&path, local(shape, chunk)).unwrap();
        for (number, (from, to)) in pieces.iter().enumerate() {
            let start: [usize; 3] = std::array::from_fn(|a| (from[a] * shape[a] as f64) as usize);
            let size: [usize; 3] =
                std::array::from_fn(|a| ((to[a] * (shape[a] - start[a] + 1) as f64) as usize).min(shape[a] - start[a]));
            // The second piece empties what it covers.
            let paint = |point| if number == 1 { f32::NAN } else { value(point) + number as f32 / 8.0 };
            volume.write_region(start, size, &region(start, size, paint)).unwrap();
            for x in start[0]..start[0] + size[0] {
                for y in start[1]..start[1] + size[1] {
                    for z in start[2]..start[2] + size[2] {
                        expected[(x * shape[1] + y) * shape[2] + z] = paint([x, y, z]);
                    }
                }
            }
        }
        let found = volume.read_region([0; 3], shape).unwrap();
        let bits = |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        prop_assert_eq!(bits(&found), bits(&expected));
        volume.finish().unwrap();
        let whole = folder.path().join("whole.zarr");
        let mut volume = ZarrVolume::create(&whole, local(shape, chunk)).unwrap();
        volume.write_region([0; 3], shape, &expected).unwrap();
        volume.finish().unwrap();
        prop_assert!(files(&path) == files(&whole));
    }
}

#[test]
fn a_volume_appears_whole_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.zarr");
    let entries = || std::fs::read_dir(folder.path()).unwrap().count();
    let ones = [1.0; 8];
    {
        let mut volume = ZarrVolume::create(&path, local([2; 3], [2; 3])).unwrap();
        volume.write_region([0; 3], [2; 3], &ones).unwrap();
        assert_eq!(entries(), 1);
    }
    assert_eq!(entries(), 0, "dropped, it leaves nothing");
    for last in [1.0, 2.0] {
        let mut volume = ZarrVolume::create(&path, local([2; 3], [2; 3])).unwrap();
        volume.write_region([0; 3], [2; 3], &[last; 8]).unwrap();
        volume.finish().unwrap();
        assert_eq!(entries(), 1, "the second replaces the first");
    }
    let reopened =
        ZarrVolume::resume(&folder.path().join("w.zarr"), &path, local([2; 3], [2; 3])).unwrap();
    assert_eq!(reopened.read_region([0; 3], [2; 3]).unwrap(), [2.0; 8]);

    let other = folder.path().join("other");
    std::fs::create_dir(&other).unwrap();
    std::fs::write(other.join("holiday.jpg"), b"x").unwrap();
    let error = ZarrVolume::create(&other, local([2; 3], [2; 3])).unwrap_err().to_string();
    assert!(error.contains("other") && error.contains("holds no Zarr volume"), "{error}");
    assert!(matches!(
        ZarrVolume::create(&folder.path().join("none/v.zarr"), local([2; 3], [2; 3])),
        Err(VolumeError::Io { .. })
    ));
}

#[test]
fn an_interrupted_volume_goes_on_where_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let (path, work) = (folder.path().join("v.zarr"), folder.path().join("work"));
    let (shape, chunk) = ([6, 4, 4], [4, 4, 4]);
    let mut volume = ZarrVolume::resume(&path, &work, local(shape, chunk)).unwrap();
    volume.write_region([0; 3], [4; 3], &region([0; 3], [4; 3], value)).unwrap();
    drop(volume);
    std::fs::write(work.join("density/c/0/0/.0.abc.part"), b"half").unwrap();
    let error = ZarrVolume::resume(&path, &work, local(shape, [2; 3])).unwrap_err().to_string();
    assert!(error.contains("another description"), "{error}");
    let mut volume = ZarrVolume::resume(&path, &work, local(shape, chunk)).unwrap();
    let rest = [4, 0, 0];
    volume.write_region(rest, [2, 4, 4], &region(rest, [2, 4, 4], value)).unwrap();
    volume.finish().unwrap();
    assert!(!work.exists());
    let once = folder.path().join("once.zarr");
    let mut volume = ZarrVolume::create(&once, local(shape, chunk)).unwrap();
    volume.write_region([0; 3], shape, &region([0; 3], shape, value)).unwrap();
    volume.finish().unwrap();
    assert!(files(&path) == files(&once));
}

#[test]
fn regions_and_descriptions_that_do_not_fit_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.zarr");
    let mut volume = ZarrVolume::create(&path, local([3, 4, 5], [2; 3])).unwrap();
    let error = volume.write_region([2, 0, 0], [2, 1, 1], &[0.0; 2]).unwrap_err().to_string();
    assert!(error.contains("[2, 0, 0]") && error.contains("[3, 4, 5]"), "{error}");
    assert!(volume.write_region([0; 3], [1, 1, 2], &[0.0; 3]).is_err());
    assert!(volume.write_region([usize::MAX, 0, 0], [2, 1, 1], &[0.0; 2]).is_err());
    assert!(volume.write_region([0; 3], [0, 1, 1], &[]).is_ok());
    for (shape, chunk) in
        [([0, 1, 1], [1; 3]), ([1; 3], [0, 1, 1]), ([1; 3], [1 << 20, 1 << 20, 1])]
    {
        let error = ZarrVolume::create(&path, local(shape, chunk)).unwrap_err();
        assert!(matches!(error, VolumeError::Description { .. }), "{error}");
    }
    let mut endless = local([1; 3], [1; 3]);
    endless.axes.z[0] = f64::INFINITY;
    let error = ZarrVolume::create(&path, endless).unwrap_err().to_string();
    assert!(error.contains("inf"), "{error}");

    // A chunk that was damaged on disk is not taken for values.
    let work = folder.path().join("work");
    let mut volume = ZarrVolume::resume(&path, &work, local([4; 3], [4; 3])).unwrap();
    volume.write_region([0; 3], [4; 3], &region([0; 3], [4; 3], value)).unwrap();
    let chunk = work.join("density/c/0/0/0");
    let mut bytes = std::fs::read(&chunk).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    std::fs::write(&chunk, bytes).unwrap();
    let error = volume.write_region([0; 3], [1; 3], &[0.0]).unwrap_err().to_string();
    assert!(error.contains("c/0/0/0") && error.contains("damaged"), "{error}");
}
