//! Palettes of 256 colours, for indexed PNG and for GIF.

/// Colours of a palette.
const PALETTE: usize = 256;
/// Bits per channel of the histogram from which the palette is made.
const BITS: u32 = 5;

/// A palette made by median cut over a histogram of 15-bit colours.
#[derive(Clone, Debug, PartialEq)]
pub struct Palette {
    colours: Vec<[u8; 3]>,
    /// Palette index of each 15-bit colour that occurs.
    index: Vec<u8>,
}

/// The bin of a colour.
fn bin(rgb: [u8; 3]) -> usize {
    rgb.iter().fold(0, |sum, c| (sum << BITS) | usize::from(c >> (8 - BITS)))
}

/// One occupied bin: its place, how many pixels, and the sum of their colours.
#[derive(Clone, Copy)]
struct Bin {
    place: usize,
    count: u64,
    sum: [u64; 3],
}

impl Bin {
    fn level(&self, channel: usize) -> u64 {
        self.sum[channel] / self.count
    }
}

impl Palette {
    /// The palette of pictures that share it: RGB bytes, each picture any number of pixels.
    #[must_use]
    pub fn of(pictures: &[&[u8]]) -> Self {
        let mut bins: Vec<Bin> =
            (0..1 << (3 * BITS)).map(|place| Bin { place, count: 0, sum: [0; 3] }).collect();
        for pixel in pictures.iter().flat_map(|rgb| rgb.as_chunks::<3>().0) {
            let b = &mut bins[bin(*pixel)];
            b.count += 1;
            for (sum, &level) in b.sum.iter_mut().zip(pixel) {
                *sum += u64::from(level);
            }
        }
        bins.retain(|b| b.count > 0);
        let mut boxes = vec![bins];
        while boxes.len() < PALETTE {
            // The box with the widest spread of levels, weighted by its pixels, is cut next.
            let widest = (0..boxes.len()).filter(|k| boxes[*k].len() > 1).max_by_key(|k| {
                let (channel, spread) = widest_channel(&boxes[*k]);
                let count: u64 = boxes[*k].iter().map(|b| b.count).sum();
                (spread * spread * count.isqrt(), channel, std::cmp::Reverse(*k))
            });
            let Some(k) = widest else { break };
            let mut whole = boxes.swap_remove(k);
            let (channel, _) = widest_channel(&whole);
            whole.sort_by_key(|b| (b.level(channel), b.place));
            let total: u64 = whole.iter().map(|b| b.count).sum();
            let mut sum = 0;
            let half = whole
                .iter()
                .position(|b| {
                    sum += b.count;
                    2 * sum >= total
                })
                .map_or(1, |i| (i + 1).clamp(1, whole.len() - 1));
            let upper = whole.split_off(half);
            boxes.push(whole);
            boxes.push(upper);
        }
        let mut index = vec![0; 1 << (3 * BITS)];
        let colours = boxes
            .iter()
            .zip(0_u8..=255)
            .map(|(bins, number)| {
                let count: u64 = bins.iter().map(|b| b.count).sum();
                for b in bins {
                    index[b.place] = number;
                }
                [0, 1, 2].map(|i| {
                    let sum: u64 = bins.iter().map(|b| b.sum[i]).sum();
                    ((sum + count / 2) / count.max(1)) as u8
                })
            })
            .collect();
        Self { colours, index }
    }

    /// Red, green and blue of each entry; at most 256 of them, as many as there are 15-bit colours.
    #[must_use]
    pub fn colours(&self) -> &[[u8; 3]] {
        &self.colours
    }

    /// Entry of each pixel of one of the pictures.
    #[must_use]
    pub fn indices(&self, rgb: &[u8]) -> Vec<u8> {
        rgb.as_chunks::<3>().0.iter().map(|pixel| self.index[bin(*pixel)]).collect()
    }
}

/// The channel in which a box's colours differ most, and by how many levels.
fn widest_channel(bins: &[Bin]) -> (usize, u64) {
    (0..3)
        .map(|channel| {
            let levels = bins.iter().map(|b| b.level(channel));
            let low = levels.clone().min().unwrap_or(0);
            (channel, levels.max().unwrap_or(0) - low)
        })
        .max_by_key(|(channel, spread)| (*spread, std::cmp::Reverse(*channel)))
        .unwrap_or((0, 0))
}
