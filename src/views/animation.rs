//! Frames as one film: an animated GIF, and MP4 where ffmpeg is installed.

use super::ViewError;
use super::pixels::Picture;
use crate::raster::palette::Palette;
use serde::Serialize;
use std::path::PathBuf;
use std::process::{Command, Stdio};

/// An MP4 encoder of the ffmpeg that is installed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct VideoEncoder {
    /// Its name in ffmpeg: `libx264`, `libopenh264` or `mpeg4`.
    pub codec: String,
    /// The program.
    #[serde(skip)]
    program: PathBuf,
}

impl VideoEncoder {
    /// Encoders that are taken, best first.
    const CODECS: [&str; 3] = ["libx264", "libopenh264", "mpeg4"];

    /// The ffmpeg on the search path (or the one that `SAT3D_FFMPEG` names).
    ///
    /// # Errors
    /// Why there is no video, in words.
    pub fn find() -> Result<Self, String> {
        let program = std::env::var_os("SAT3D_FFMPEG").unwrap_or_else(|| "ffmpeg".into());
        let program = PathBuf::from(program);
        let asked = Command::new(&program)
            .args(["-hide_banner", "-encoders"])
            .stdin(Stdio::null())
            .output();
        let list = match asked {
            Ok(output) if output.status.success() => output.stdout,
            Ok(output) => {
                return Err(format!("`{}` ends with {}", program.display(), output.status));
            }
            Err(error) => return Err(format!("`{}` does not run: {error}", program.display())),
        };
        let list = String::from_utf8_lossy(&list);
        let has = |codec: &&str| list.split_whitespace().any(|word| word == *codec);
        match Self::CODECS.into_iter().find(has) {
            Some(codec) => Ok(Self { codec: codec.to_owned(), program }),
            None => Err(format!(
                "`{}` has none of the encoders {}",
                program.display(),
                Self::CODECS.join(", ")
            )),
        }
    }

    /// Frames of one size as the bytes of an MP4. An odd last row or column is cut off, since the colour
    /// format has a colour for each 2 x 2 pixels.
    ///
    /// # Errors
    /// [`ViewError::Encode`] with what ffmpeg said.
    pub fn encode(&self, frames: &[Picture], fps: u32) -> Result<Vec<u8>, ViewError> {
        let fail = |why: String| ViewError::Encode { what: "MP4", why };
        let Some(first) = frames.first() else { return Err(fail("no frames".to_owned())) };
        let size = format!("{}x{}", first.width, first.height);
        let mut raw = Vec::with_capacity(frames.len() * first.rgb.len());
        for frame in frames {
            raw.extend_from_slice(&frame.rgb);
        }
        // Through files: an MP4 cannot be written to a pipe, and two pipes may wait for each other.
        let io = |error: std::io::Error| fail(error.to_string());
        let folder = tempfile::tempdir().map_err(io)?;
        let (input, output) = (folder.path().join("frames.rgb"), folder.path().join("film.mp4"));
        std::fs::write(&input, raw).map_err(io)?;
        let run = Command::new(&self.program)
            .args(["-nostdin", "-hide_banner", "-loglevel", "error"])
            .args(["-f", "rawvideo", "-pixel_format", "rgb24", "-video_size", &size])
            .args(["-framerate", &fps.to_string(), "-i"])
            .arg(&input)
            .args(["-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2", "-pix_fmt", "yuv420p"])
            .args(["-c:v", &self.codec])
            // The same frames give the same bytes, with the same ffmpeg.
            .args(["-threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact"])
            .args(["-map_metadata", "-1", "-movflags", "+faststart"])
            .arg(&output)
            .stdin(Stdio::null())
            .output()
            .map_err(io)?;
        if !run.status.success() {
            let said = String::from_utf8_lossy(&run.stderr);
            return Err(fail(format!("ffmpeg ends with {}: {}", run.status, said.trim())));
        }
        std::fs::read(&output).map_err(io)
    }
}

/// Frames of one size as the bytes of a GIF that begins again at its end. All frames share one palette, so
/// that no colour changes from frame to frame where the scene does not.
///
/// # Errors
/// [`ViewError::Encode`] for frames of different sizes, none, or too large ones (65535 pixels a side).
pub fn gif(frames: &[Picture], fps: u32) -> Result<Vec<u8>, ViewError> {
    let fail = |why: String| ViewError::Encode { what: "GIF", why };
    let Some(first) = frames.first() else { return Err(fail("no frames".to_owned())) };
    let side = |side: usize| {
        u16::try_from(side).map_err(|_| fail(format!("{side} pixels a side; 65535 is the most")))
    };
    let (width, height) = (side(first.width)?, side(first.height)?);
    if let Some(other) = frames.iter().find(|f| (f.width, f.height) != (first.width, first.height))
    {
        let (w, h) = (other.width, other.height);
        return Err(fail(format!("frames of {width} x {height} and of {w} x {h} pixels")));
    }
    let pictures: Vec<&[u8]> = frames.iter().map(|frame| &frame.rgb[..]).collect();
    let palette = Palette::of(&pictures);
    let encoding = |error: gif::EncodingError| fail(error.to_string());
    let mut encoder =
        gif::Encoder::new(Vec::new(), width, height, palette.colours().as_flattened())
            .map_err(encoding)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(encoding)?;
    for (index, frame) in frames.iter().enumerate() {
        encoder
            .write_frame(&gif::Frame {
                width,
                height,
                delay: hundredths(index as u64 + 1, fps) - hundredths(index as u64, fps),
                buffer: palette.indices(&frame.rgb).into(),
                ..gif::Frame::default()
            })
            .map_err(encoding)?;
    }
    encoder.into_inner().map_err(|error| fail(error.to_string()))
}

/// When a frame begins: GIF counts hundredths of a second, so that the frames' lengths differ by one where
/// the rate does not divide 100.
fn hundredths(frame: u64, fps: u32) -> u16 {
    let fps = u64::from(fps.max(1));
    // Only differences count; they survive the wrap.
    ((200 * frame + fps) / (2 * fps)) as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(count: usize) -> Vec<Picture> {
        let frame = |k: usize| {
            let pixel = |i: usize| {
                let (x, y) = (i % 48, i / 48);
                [(x * 5) as u8, (y * 7) as u8, if x / 8 == k { 255 } else { 40 }]
            };
            Picture { width: 48, height: 32, rgb: (0..48 * 32).flat_map(pixel).collect() }
        };
        (0..count).map(frame).collect()
    }

    #[test]
    fn a_gif_holds_the_frames_and_their_times() {
        let frames = frames(5);
        let bytes = gif(&frames, 30).expect("encodes");
        assert_eq!(bytes, gif(&frames, 30).expect("encodes"));
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(&bytes[..]).expect("a GIF");
        assert_eq!((decoder.width(), decoder.height()), (48, 32));
        let mut delays = Vec::new();
        for frame in &frames {
            let read = decoder.read_next_frame().expect("reads").expect("a frame");
            delays.push(read.delay);
            let pixels = read.buffer.as_chunks::<4>().0.iter().zip(frame.rgb.as_chunks::<3>().0);
            let worst = pixels.flat_map(|(a, b)| (0..3).map(|i| a[i].abs_diff(b[i]))).max();
            assert!(worst < Some(24), "{worst:?}");
        }
        assert!(decoder.read_next_frame().expect("reads").is_none());
        assert_eq!(decoder.repeat(), gif::Repeat::Infinite);
        // Three hundredths and a third each.
        assert_eq!(delays, [3, 4, 3, 3, 4]);
    }

    #[test]
    fn frames_that_make_no_film_are_refused() {
        let mut mixed = frames(2);
        mixed[1] = Picture { width: 2, height: 1, rgb: vec![0; 6] };
        assert!(gif(&mixed, 5).is_err_and(|e| e.to_string().contains("2 x 1")));
        assert!(gif(&[], 5).is_err());
        let wide = Picture { width: 70_000, height: 1, rgb: vec![0; 210_000] };
        assert!(gif(&[wide], 5).is_err_and(|e| e.to_string().contains("70000")));
    }

    #[test]
    fn an_mp4_of_the_installed_ffmpeg() {
        match VideoEncoder::find() {
            Ok(encoder) => {
                let bytes = encoder.encode(&frames(5), 5).expect("encodes");
                assert_eq!(&bytes[4..8], b"ftyp");
                assert_eq!(bytes, encoder.encode(&frames(5), 5).expect("encodes"));
            }
            Err(why) => {
                use std::io::Write as _;
                let _ = writeln!(std::io::stderr(), "SKIPPED MP4: {why}");
            }
        }
    }
}
