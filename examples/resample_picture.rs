//! Resizes a picture of any size in a stream, and says what that took.
//!
//! `cargo run --release --example resample_picture -- IN COLUMNS ROWS OUT.png`

use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [input, columns, rows, output] = &arguments[..] else {
        return Err("usage: resample_picture IN COLUMNS ROWS OUT.png".into());
    };
    let size = [columns.parse::<u32>()?, rows.parse::<u32>()?];
    if size.contains(&0) {
        return Err("columns and rows have to be at least 1".into());
    }
    let picture = sat3d::picture::open(Path::new(input))?;
    for warning in picture.warnings() {
        eprintln!("{warning}");
    }
    println!("{:?} pixels, read by {:?}", picture.size(), picture.access());
    let mut stream = sat3d::picture::ResampledPicture::new(picture, size);
    let mut encoder = png::Encoder::new(std::fs::File::create(output)?, size[0], size[1]);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::Fastest);
    let mut writer = encoder.write_header()?;
    let mut writer = writer.stream_writer()?;
    let mut band = vec![0; size[0] as usize * 3 * 64];
    loop {
        match stream.next_rows(&mut band)? {
            0 => break,
            count => {
                std::io::Write::write_all(&mut writer, &band[..count * size[0] as usize * 3])?;
            }
        }
    }
    writer.finish()?;
    // What Linux says of the process's largest memory so far.
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    if let Some(peak) = status.lines().find_map(|line| line.strip_prefix("VmHWM:")) {
        println!("peak memory {}", peak.trim());
    }
    Ok(())
}
