use super::*;
use proptest::prelude::*;

fn grid(values: &[f32], shape: &[usize]) -> Vec<u8> {
    encode(&[NpyArray { name: "dsm", shape, data: NpyData::F32(values) }], Compression::Fast)
}

fn reason(bytes: &[u8]) -> String {
    parse(bytes, Path::new("x.npz")).expect_err("must be refused").to_string()
}

#[test]
fn arrays_of_every_type_come_back() {
    let f32s = [1.5_f32, f32::NAN, -0.0, f32::MIN_POSITIVE, 5.0, 6.0];
    let f64s = [1e300_f64, -2.0];
    let (u8s, i8s, u16s, i16s) = ([0_u8, 255], [-128_i8, 127], [65_535_u16], [-32_768_i16]);
    let (u32s, i32s, u64s, i64s) = ([u32::MAX], [i32::MIN], [u64::MAX], [i64::MIN]);
    let array = |name, shape, data| NpyArray { name, shape, data };
    let arrays = [
        array("dsm", &[2, 3][..], NpyData::F32(&f32s)),
        array("b", &[2], NpyData::F64(&f64s)),
        array("c", &[2, 1, 1], NpyData::U8(&u8s)),
        array("d", &[2], NpyData::I8(&i8s)),
        array("e", &[1], NpyData::U16(&u16s)),
        array("f", &[1], NpyData::I16(&i16s)),
        array("g", &[1], NpyData::U32(&u32s)),
        array("h", &[1], NpyData::I32(&i32s)),
        array("i", &[], NpyData::U64(&u64s)),
        array("Höhe", &[1], NpyData::I64(&i64s)),
        array("none", &[0, 5], NpyData::F32(&[])),
    ];
    for compression in [Compression::Stored, Compression::Fast, Compression::Small] {
        let bytes = encode(&arrays, compression);
        assert_eq!(bytes, encode(&arrays, compression));
        let back = parse(&bytes, Path::new("x.npz")).expect("reads");
        assert_eq!(back.len(), arrays.len());
        for ((name, owned), array) in back.iter().zip(&arrays) {
            assert_eq!(name, array.name);
            assert_eq!(owned.shape, array.shape);
            assert_eq!(owned.values.descr(), array.data.descr());
        }
        let NpyValues::F32(values) = &back[0].1.values else { panic!("f32 became {back:?}") };
        assert!(values.iter().zip(&f32s).all(|(a, b)| a.to_bits() == b.to_bits()));
        assert_eq!(back[9].1.values, NpyValues::I64(vec![i64::MIN]));
    }
}

#[test]
fn one_array_is_found_by_name_and_a_missing_one_names_the_others() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("x.npz");
    std::fs::write(&path, grid(&[1.0, 2.0], &[2])).expect("writes");
    assert_eq!(read_one(&path, "dsm").expect("reads").values, NpyValues::F32(vec![1.0, 2.0]));
    let error = read_one(&path, "arr_0").expect_err("is not there").to_string();
    assert!(error.contains("no array `arr_0`; it has `dsm`"), "{error}");
    let npy = folder.path().join("x.npy");
    let mut bytes = npy::header(">i2", &[2]);
    bytes.extend_from_slice(&[0xff, 0xfe, 0x00, 0x03]);
    std::fs::write(&npy, bytes).expect("writes");
    assert_eq!(read_one(&npy, "arr_0").expect("reads").values, NpyValues::I16(vec![-2, 3]));
    assert!(matches!(read(&folder.path().join("none.npz")), Err(NpzError::Io { .. })));
}

#[test]
fn fortran_order_becomes_row_major() {
    // Element (i, j, k) has the value 100 i + 10 j + k.
    let shape = [2, 3, 4];
    let mut fortran = Vec::new();
    let mut wanted = Vec::new();
    for k in 0..4 {
        for j in 0..3 {
            for i in 0..2 {
                fortran.push(100 * i + 10 * j + k);
            }
        }
    }
    for i in 0..2 {
        for j in 0..3 {
            for k in 0..4 {
                wanted.push(100 * i + 10 * j + k);
            }
        }
    }
    assert_eq!(npy::to_row_major(&fortran, &shape), wanted);
    let mut bytes = npy::header("<f4", &[2, 2]);
    let at = bytes.windows(5).position(|w| w == b"False").expect("the order");
    bytes.splice(at..at + 5, *b"True ");
    for value in [1.0_f32, 3.0, 2.0, 4.0] {
        bytes.extend_from_slice(&value.to_le_bytes());
    }
    let back = parse(&bytes, Path::new("x.npy")).expect("reads");
    assert_eq!(back[0].1.values, NpyValues::F32(vec![1.0, 2.0, 3.0, 4.0]));
}

#[test]
fn zip64_archives_are_read_back() {
    let array = |name| NpyArray { name, shape: &[2], data: NpyData::F32(&[1.0, 2.0]) };
    // From 0 on everything is wide; from 200 on sizes are not and later offsets are.
    for limit in [0, 200] {
        let mut archive = zip::Writer::with_zip64_from(limit);
        add_all(&mut archive, &[array("a"), array("b"), array("c")], Compression::Stored);
        let bytes = archive.finish();
        let back = parse(&bytes, Path::new("x.npz")).expect("reads");
        let names: Vec<&str> = back.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["a", "b", "c"]);
        assert!(back.iter().all(|(_, a)| a.values == NpyValues::F32(vec![1.0, 2.0])));
    }
}

#[test]
#[should_panic(expected = "values of array `dsm` of shape [2, 2]")]
fn a_shape_that_does_not_fit_is_a_bug() {
    let array = NpyArray { name: "dsm", shape: &[2, 2], data: NpyData::F32(&[1.0, 2.0]) };
    let _ = encode(&[array], Compression::Fast);
}

#[test]
fn damage_is_named() {
    let good = grid(&[1.0, 2.0, 3.0, 4.0], &[2, 2]);
    assert!(reason(b"").contains("empty"));
    assert!(reason(b"just some text, no archive").contains("neither an npz"));
    assert!(reason(&good[..good.len() - 1]).contains("cut off"));
    let mut bytes = npy::header("<f4", &[1 << 40, 1 << 40]);
    assert!(reason(&bytes).contains("does not fit its 0 bytes"), "{}", reason(&bytes));
    bytes.truncate(20);
    assert!(reason(&bytes).contains("header is cut off"));
    let complex = [npy::header("<c8", &[1]), vec![0; 8]].concat();
    assert!(reason(&complex).contains("`<c8` are not read"), "{}", reason(&complex));
    // A false size in the central directory (bytes 24 to 27 of the entry).
    let mut false_size = good.clone();
    let entry = good.windows(4).position(|w| w == b"PK\x01\x02").expect("the directory");
    false_size[entry + 24..entry + 28].copy_from_slice(&0x7fff_ffff_u32.to_le_bytes());
    assert!(reason(&false_size).contains("are stated"), "{}", reason(&false_size));
    let mut other_method = good.clone();
    other_method[entry + 10] = 12;
    assert!(reason(&other_method).contains("method 12"));
    let mut encrypted = good;
    encrypted[entry + 8] |= 1;
    assert!(reason(&encrypted).contains("encrypted"));
}

proptest! {
    /// Whatever is flipped or cut: an error or the right values, never a panic, never wrong values.
    #[test]
    fn damaged_files_never_give_wrong_values(
        position in any::<prop::sample::Index>(), flip in 1..=255_u8, cut in any::<bool>(),
    ) {
        let values: Vec<f32> = (0..200).map(|i| i as f32 * 0.25).collect();
        let mut bytes = grid(&values, &[10, 20]);
        let at = position.index(bytes.len());
        if cut { bytes.truncate(at) } else { bytes[at] ^= flip }
        if let Ok(back) = parse(&bytes, Path::new("x.npz")) {
            for (_, array) in back {
                prop_assert_eq!(array.values, NpyValues::F32(values.clone()));
            }
        }
    }
}

#[test]
fn shapes_come_from_headers_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("x.npz");
    // Larger than what is looked at, and hard to compress.
    let values: Vec<f32> =
        (0..300 * 200_u32).map(|k| (k.wrapping_mul(2_654_435_761)) as f32).collect();
    let arrays = [
        NpyArray { name: "dsm", shape: &[300, 200], data: NpyData::F32(&values) },
        NpyArray { name: "metres_per_unit", shape: &[], data: NpyData::F64(&[64.48]) },
    ];
    for compression in [Compression::Stored, Compression::Fast, Compression::Small] {
        let bytes = encode(&arrays, compression);
        std::fs::write(&file, &bytes).expect("writes");
        let found = shapes(&file).expect("reads");
        assert_eq!(
            found,
            [("dsm".to_owned(), vec![300, 200]), ("metres_per_unit".to_owned(), vec![])]
        );
        // Values that are damaged do not matter, an end that is cut off does.
        let mut damaged = bytes.clone();
        damaged[20_000..20_100].fill(0xff);
        std::fs::write(&file, &damaged).expect("writes");
        assert_eq!(shapes(&file).expect("reads"), found);
        assert!(read(&file).is_err());
        std::fs::write(&file, &bytes[..bytes.len() - 30]).expect("writes");
        assert!(shapes(&file).is_err());
    }
    let npy = folder.path().join("x.npy");
    std::fs::write(&npy, [npy_header_f32(&[7, 9]), vec![0; 7 * 9 * 4]].concat()).expect("writes");
    assert_eq!(shapes(&npy).expect("reads"), [("arr_0".to_owned(), vec![7, 9])]);
}
