//! The match finder for grids of 32-bit samples.
//!
//! In a little-endian `f32` height the lowest byte is noise, the upper three repeat: at 50 m they
//! stand for 1 mm, and a neighbour within the 32 KB window (12 rows of 640 pixels) often has the same.
//! zlib finds these three-byte matches by walking hash chains at every byte; here one probe per
//! sample, with the upper three bytes as key, gives the nearest one. Equal samples in sequence
//! (voids, water, constant areas) become matches of up to 258 bytes.

use super::bits::BitWriter;
use super::huffman::{
    BlockPlan, Code, Codes, Counts, DISTANCE_EXTRA, DISTANCE_SYMBOLS, END_OF_BLOCK, LENGTH_3,
    LENGTH_BASE, LENGTH_EXTRA, LENGTH_SYMBOL, distance_base, distance_symbol, plan_block,
};
use super::write_block;

/// Samples in one block: each has codes of its own.
const BLOCK: usize = 16 * 1024;
/// Farthest match, in samples (32 KB).
const WINDOW: usize = 8192;
const HASH_BITS: u32 = 15;

/// Token of a sample written as four literals; 1 to [`WINDOW`] is a literal and a match of the
/// upper three bytes at that distance.
const LITERALS: u16 = 0;
/// Token that stands for the next [`Run`].
const RUN: u16 = u16::MAX;

/// Distance symbol of each distance in samples.
static SYMBOL_OF_SAMPLES: [u8; 2 * WINDOW] = {
    let mut table = [0; 2 * WINDOW];
    let mut d = 1;
    while d <= WINDOW {
        table[d] = distance_symbol(4 * d as u32) as u8;
        d += 1;
    }
    table
};

/// A match that covers whole samples.
#[derive(Clone, Copy, Debug)]
struct Run {
    /// Distance in samples.
    distance: u16,
    /// Samples covered, the first one included.
    samples: u32,
    /// Whether the first sample's lowest byte differs and comes before the match as a literal.
    literal_first: bool,
}

impl Run {
    /// Calls `piece` with the length of each match that the run is written as: 3 to 258 bytes.
    fn pieces(self, mut piece: impl FnMut(usize)) {
        let mut left = 4 * self.samples as usize - usize::from(self.literal_first);
        while left > 258 {
            // No piece may be left with fewer than 3 bytes.
            let take = if left < 258 + 3 { left - 3 } else { 258 };
            piece(take);
            left -= take;
        }
        piece(left);
    }
}

/// What symbols cost, in bits, learnt from the block before; decides between match and literals.
struct Costs {
    literal: [u8; 256],
    /// Of a match of three bytes, by distance symbol, extra bits included.
    short_match: [u8; DISTANCE_SYMBOLS],
}

impl Costs {
    /// A guess for the first block.
    const GUESS: Self = Self { literal: [7; 256], short_match: [18; DISTANCE_SYMBOLS] };

    fn of(codes: &Codes) -> Self {
        // A symbol that did not occur may still be useful: without this ceiling a code that once
        // had no matches would never get any.
        let or = |code: Code, ceiling: u8| if code.len == 0 { ceiling } else { code.len };
        let length = or(codes.litlen[LENGTH_3], 6);
        Self {
            literal: std::array::from_fn(|i| or(codes.litlen[i], 12)),
            short_match: std::array::from_fn(|s| {
                length + or(codes.distance[s], 7) + DISTANCE_EXTRA[s]
            }),
        }
    }
}

/// The samples of one block as tokens.
#[derive(Default)]
struct Tokens {
    /// One per sample outside runs, one per run.
    tokens: Vec<u16>,
    runs: Vec<Run>,
}

struct Finder {
    /// Low 16 bits of the last position with each hash of the upper three bytes; stale ones are
    /// harmless, because every candidate is compared.
    last: Box<[u16; 1 << HASH_BITS]>,
    /// The same for two whole samples in sequence.
    last_pair: Box<[u16; 1 << HASH_BITS]>,
}

#[inline(always)]
const fn hash(key: u32) -> usize {
    (key.wrapping_mul(0x9E37_79B1) >> (32 - HASH_BITS)) as usize
}

#[inline(always)]
const fn hash_pair(a: u32, b: u32) -> usize {
    hash(a ^ b.rotate_left(16))
}

/// Puts `at` in `slot` and gives the distance to what was there, 0 if that is out of reach.
#[inline(always)]
fn distance_to_last(slot: &mut u16, at: usize) -> usize {
    let distance = usize::from((at as u16).wrapping_sub(*slot));
    *slot = at as u16;
    if distance <= WINDOW.min(at) { distance } else { 0 }
}

impl Finder {
    fn new() -> Self {
        Self { last: Box::new([0; 1 << HASH_BITS]), last_pair: Box::new([0; 1 << HASH_BITS]) }
    }

    /// Tokenises `samples[start..end]`, and counts its symbols (without the end of the block).
    /// `PAIRS` looks for two equal samples in sequence first: heights on few levels repeat so often
    /// that the nearest equal one seldom begins a long run.
    fn block<const PAIRS: bool>(
        &mut self,
        samples: &[u32],
        start: usize,
        end: usize,
        costs: &Costs,
        out: &mut Tokens,
    ) -> Counts {
        out.tokens.clear();
        out.runs.clear();
        // Separate counters for the four bytes: increments of one counter in a row would wait for
        // each other.
        let mut literals = [[0_u32; 256]; 4];
        let mut short_matches = [0_u32; DISTANCE_SYMBOLS];
        let mut counts = Counts::new();
        let samples = &samples[..end];
        let mut at = start;
        while at < end {
            let value = samples[at];
            let next = (at + 1).min(end - 1);
            let mut distance = distance_to_last(&mut self.last[hash(value >> 8)], at);
            if PAIRS {
                let slot = &mut self.last_pair[hash_pair(value, samples[next])];
                let pair = distance_to_last(slot, at);
                if samples[at - pair] == value && samples[next - pair] == samples[next] && pair > 0
                {
                    distance = pair;
                }
            }
            let [b0, b1, b2, b3] = value.to_le_bytes().map(usize::from);
            // Whether a sample has a match is as good as random, so that a branch would be guessed
            // wrong too often: up to the rare runs all goes without, by counts that grow by 0 or 1.
            let difference = samples[at - distance] ^ value;
            let matches = (distance > 0) & (difference < 256);
            let symbol = usize::from(SYMBOL_OF_SAMPLES[distance]);
            let next_is_equal = samples[next] == samples[next - distance];
            if matches & ((difference == 0) | next_is_equal) {
                let run = self.run(samples, at, distance);
                literals[0][b0] += u32::from(run.literal_first);
                run.pieces(|length| {
                    let length = usize::from(LENGTH_SYMBOL[length - 3]);
                    counts.litlen[LENGTH_3 + length] += 1;
                    counts.distance[symbol] += 1;
                });
                out.tokens.push(RUN);
                out.runs.push(run);
                at += run.samples as usize;
                continue;
            }
            let as_literals = costs.literal[b1] + costs.literal[b2] + costs.literal[b3];
            let short = matches & (costs.short_match[symbol] <= as_literals);
            literals[0][b0] += 1;
            literals[1][b1] += u32::from(!short);
            literals[2][b2] += u32::from(!short);
            literals[3][b3] += u32::from(!short);
            short_matches[symbol] += u32::from(short);
            out.tokens.push(if short { distance as u16 } else { LITERALS });
            at += 1;
        }
        for (i, count) in counts.litlen[..256].iter_mut().enumerate() {
            *count += literals.iter().map(|l| l[i]).sum::<u32>();
        }
        for (count, &n) in counts.distance.iter_mut().zip(&short_matches) {
            *count += n;
            counts.litlen[LENGTH_3] += n;
        }
        counts
    }

    /// The longest run of samples equal to those `distance` before, from `at` on; the first may
    /// differ in its lowest byte.
    fn run(&mut self, samples: &[u32], at: usize, distance: usize) -> Run {
        let literal_first = samples[at] != samples[at - distance];
        let later = samples[at + 1..]
            .iter()
            .zip(&samples[at + 1 - distance..])
            .take_while(|(a, b)| a == b)
            .count();
        // The run repeats every `distance` samples: its last ones stand for all of it.
        let first = at + 1 + later.saturating_sub(distance);
        for (i, sample) in (first..).zip(&samples[first..=at + later]) {
            self.last[hash(sample >> 8)] = i as u16;
        }
        Run { distance: distance as u16, samples: 1 + later as u32, literal_first }
    }
}

#[derive(Clone, Copy)]
struct Literal {
    bits: u16,
    scale: u16,
    len: u32,
}

/// Two codes in sequence.
#[derive(Clone, Copy, Default)]
struct Pair {
    bits: u32,
    scale: u32,
    /// Extra bits included.
    len: u16,
    /// Distance (bytes) at which the extra bits are zero.
    base: u16,
}

/// Appends `data` (whose length is a multiple of 4) as DEFLATE blocks, the last one marked if
/// `last`.
pub(super) fn deflate(data: &[u8], last: bool, out: &mut BitWriter) {
    let samples: Vec<u32> =
        data.as_chunks::<4>().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect();
    let mut finder = Finder::new();
    let mut tokens = Tokens::default();
    let mut costs = Costs::GUESS;
    for start in (0..samples.len()).step_by(BLOCK) {
        let end = (start + BLOCK).min(samples.len());
        let repetitive = 4 * tokens.runs.len() > tokens.tokens.len();
        let mut counts = if repetitive {
            finder.block::<true>(&samples, start, end, &costs, &mut tokens)
        } else {
            finder.block::<false>(&samples, start, end, &costs, &mut tokens)
        };
        counts.litlen[END_OF_BLOCK] = 1;
        let plan = plan_block(&counts, 4 * (end - start));
        if let BlockPlan::Dynamic { codes, .. } | BlockPlan::Fixed { codes, .. } = &plan {
            costs = Costs::of(codes);
        }
        let raw = &data[4 * start..4 * end];
        write_block(out, &plan, raw, last && end == samples.len(), |codes, out| {
            write_tokens(&samples[start..end], &tokens, codes, out);
        });
    }
}

fn write_tokens(samples: &[u32], tokens: &Tokens, codes: &Codes, out: &mut BitWriter) {
    let literal: [Literal; 256] = std::array::from_fn(|i| {
        let code = codes.litlen[i];
        Literal { bits: code.bits, scale: 1 << code.len, len: u32::from(code.len) }
    });
    let length_3 = codes.litlen[LENGTH_3];
    let short_match: [Pair; DISTANCE_SYMBOLS] = std::array::from_fn(|s| {
        let distance = codes.distance[s];
        Pair {
            bits: u32::from(length_3.bits) | u32::from(distance.bits) << length_3.len,
            len: u16::from(length_3.len + distance.len + DISTANCE_EXTRA[s]),
            scale: 1 << (length_3.len + distance.len),
            base: distance_base(s as u32) as u16,
        }
    });
    let mut runs = tokens.runs.iter();
    let mut at = 0;
    for &token in &tokens.tokens {
        let [b0, b1, b2, b3] = samples[at].to_le_bytes().map(|b| literal[usize::from(b)]);
        if token == LITERALS {
            let low = u64::from(b0.bits) + u64::from(b1.bits) * u64::from(b0.scale);
            let high = u64::from(b2.bits) + u64::from(b3.bits) * u64::from(b2.scale);
            let scale = u64::from(b0.scale) * u64::from(b1.scale);
            out.put(low + high * scale, b0.len + b1.len + b2.len + b3.len);
            at += 1;
        } else if token != RUN {
            let pair = short_match[usize::from(SYMBOL_OF_SAMPLES[usize::from(token)])];
            let extra = u64::from(4 * u32::from(token) - u32::from(pair.base));
            let coded = u64::from(pair.bits) + extra * u64::from(pair.scale);
            out.put(u64::from(b0.bits) + coded * u64::from(b0.scale), b0.len + u32::from(pair.len));
            at += 1;
        } else if let Some(run) = runs.next() {
            if run.literal_first {
                out.put(u64::from(b0.bits), b0.len);
            }
            let bytes = 4 * u32::from(run.distance);
            let symbol = distance_symbol(bytes);
            let distance = codes.distance[symbol as usize];
            let extra = bytes - distance_base(symbol);
            run.pieces(|length| {
                let symbol_offset = usize::from(LENGTH_SYMBOL[length - 3]);
                let code = codes.litlen[LENGTH_3 + symbol_offset];
                let length_extra = length as u64 - u64::from(LENGTH_BASE[symbol_offset]);
                out.put(
                    u64::from(code.bits) | length_extra << code.len,
                    u32::from(code.len + LENGTH_EXTRA[symbol_offset]),
                );
                out.put(
                    u64::from(distance.bits) | u64::from(extra) << distance.len,
                    u32::from(distance.len) + u32::from(DISTANCE_EXTRA[symbol as usize]),
                );
            });
            at += run.samples as usize;
        }
    }
}
