//! Prefix codes: lengths from counts, canonical codes, and the header of a dynamic block.

use super::bits::BitWriter;

/// Literals, end of block, and lengths: symbols 0 to 285.
pub(super) const LITLEN_SYMBOLS: usize = 286;
/// Distance symbols 0 to 29.
pub(super) const DISTANCE_SYMBOLS: usize = 30;
/// The symbol that ends a block.
pub(super) const END_OF_BLOCK: usize = 256;
/// The first length symbol (length 3).
pub(super) const LENGTH_3: usize = 257;

/// Longest code in use. DEFLATE allows 15; with 14, four literals (or a literal, a length, a
/// distance and its extra bits) fit into what a 64-bit accumulator has free after a flush, and the
/// one bit costs nothing measurable.
pub(super) const CODE_LIMIT: u8 = 14;

/// Order in which the lengths of the code-length code are stored (RFC 1951, 3.2.7).
const LENGTH_CODE_ORDER: [usize; 19] =
    [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];

/// How often each symbol occurs in a block.
#[derive(Clone, Debug)]
pub(super) struct Counts {
    pub litlen: [u32; LITLEN_SYMBOLS],
    pub distance: [u32; DISTANCE_SYMBOLS],
}

impl Counts {
    pub(super) const fn new() -> Self {
        Self { litlen: [0; LITLEN_SYMBOLS], distance: [0; DISTANCE_SYMBOLS] }
    }
}

/// A code word with its bits in the order they are written, and its length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Code {
    pub bits: u16,
    pub len: u8,
}

/// The two codes of a block.
#[derive(Clone, Debug)]
pub(super) struct Codes {
    pub litlen: [Code; LITLEN_SYMBOLS],
    pub distance: [Code; DISTANCE_SYMBOLS],
}

/// How a block is written, decided by its exact size.
pub(super) enum BlockPlan {
    /// As it is: nothing is shorter.
    Stored,
    /// With codes of its own; the header is written already packed.
    Dynamic { codes: Box<Codes>, header: Header, bits: u64 },
    /// With the codes that RFC 1951 fixes (short blocks, whose header would not pay).
    Fixed { codes: Box<Codes>, bits: u64 },
}

/// Decides how to write a block of `raw_len` bytes whose symbols are counted in `counts` (end of
/// block included).
pub(super) fn plan_block(counts: &Counts, raw_len: usize) -> BlockPlan {
    let mut litlen = [0_u8; LITLEN_SYMBOLS];
    let mut distance = [0_u8; DISTANCE_SYMBOLS];
    code_lengths(&counts.litlen, CODE_LIMIT, &mut litlen);
    code_lengths(&counts.distance, CODE_LIMIT, &mut distance);
    let header = Header::new(&litlen, &distance);
    let extra = extra_bits(counts);
    let dynamic = 3 + header.bits + body_bits(counts, &litlen, &distance) + extra;
    let fixed = 3 + body_bits(counts, &FIXED_LITLEN, &FIXED_DISTANCE) + extra;
    // A stored block holds at most 65535 bytes, each with 4 bytes of length after padding.
    let stored = (raw_len as u64 + 5 * (raw_len as u64).div_ceil(65_535).max(1)) * 8 + 7;
    if stored <= dynamic.min(fixed) {
        return BlockPlan::Stored;
    }
    if fixed <= dynamic {
        let all = canonical(&FIXED_LITLEN);
        let codes = Box::new(Codes {
            litlen: std::array::from_fn(|symbol| all[symbol]),
            distance: canonical(&FIXED_DISTANCE),
        });
        return BlockPlan::Fixed { codes, bits: fixed };
    }
    let codes = Box::new(Codes { litlen: canonical(&litlen), distance: canonical(&distance) });
    BlockPlan::Dynamic { codes, header, bits: dynamic }
}

fn body_bits(counts: &Counts, litlen: &[u8], distance: &[u8]) -> u64 {
    let dot = |counts: &[u32], lengths: &[u8]| -> u64 {
        counts.iter().zip(lengths).map(|(&n, &l)| u64::from(n) * u64::from(l)).sum()
    };
    dot(&counts.litlen, litlen) + dot(&counts.distance, distance)
}

fn extra_bits(counts: &Counts) -> u64 {
    let lengths = (LENGTH_3..LITLEN_SYMBOLS)
        .map(|s| u64::from(counts.litlen[s]) * u64::from(LENGTH_EXTRA[s - LENGTH_3]));
    let distances = counts
        .distance
        .iter()
        .enumerate()
        .map(|(s, &n)| u64::from(n) * u64::from(DISTANCE_EXTRA[s]));
    lengths.sum::<u64>() + distances.sum::<u64>()
}

/// Extra bits of length symbols 257 to 285.
pub(super) const LENGTH_EXTRA: [u8; 29] =
    [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0];
/// Smallest length of symbols 257 to 285.
pub(super) const LENGTH_BASE: [u16; 29] = [
    3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131,
    163, 195, 227, 258,
];
/// Extra bits of distance symbols 0 to 29.
pub(super) const DISTANCE_EXTRA: [u8; DISTANCE_SYMBOLS] = [
    0, 0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 8, 9, 9, 10, 10, 11, 11, 12, 12, 13,
    13,
];

/// Offset (from 257) of the length symbol of each length minus 3.
pub(super) const LENGTH_SYMBOL: [u8; 256] = {
    let mut table = [0_u8; 256];
    let mut symbol = 0;
    let mut length = 3;
    while length <= 258 {
        // 258 has a symbol of its own although it would fit the one before.
        if symbol + 1 < 29 && length == LENGTH_BASE[symbol + 1] as usize {
            symbol += 1;
        }
        table[length - 3] = symbol as u8;
        length += 1;
    }
    table
};

/// Distance symbol of a distance from 1 to 32768.
pub(super) const fn distance_symbol(distance: u32) -> u32 {
    let d = distance - 1;
    if d < 4 {
        return d;
    }
    let high = 31 - d.leading_zeros();
    2 * high + ((d >> (high - 1)) & 1)
}

/// Smallest distance of a distance symbol.
pub(super) const fn distance_base(symbol: u32) -> u32 {
    if symbol < 4 { symbol + 1 } else { ((2 + (symbol & 1)) << (symbol / 2 - 1)) + 1 }
}

/// Lengths of the fixed code (RFC 1951, 3.2.6). It has 288 symbols: the two that never occur decide
/// the words of the others.
const FIXED_LITLEN: [u8; 288] = {
    let mut lengths = [8; 288];
    let mut symbol = 144;
    while symbol < 280 {
        lengths[symbol] = if symbol < 256 { 9 } else { 7 };
        symbol += 1;
    }
    lengths
};
const FIXED_DISTANCE: [u8; DISTANCE_SYMBOLS] = [5; DISTANCE_SYMBOLS];

/// Code lengths for `counts`: Huffman's, shortened to `limit` bits where they are longer. Symbols
/// that never occur get 0; at least two symbols get a code, because some decoders refuse less.
pub(super) fn code_lengths(counts: &[u32], limit: u8, lengths: &mut [u8]) {
    lengths.fill(0);
    let mut leaves: Vec<(u32, u16)> = counts
        .iter()
        .enumerate()
        .filter(|&(_, &count)| count > 0)
        .map(|(symbol, &count)| (count, symbol as u16))
        .collect();
    if leaves.len() < 2 {
        lengths[..2].fill(1);
        if let Some(&(_, symbol)) = leaves.first()
            && symbol > 1
        {
            lengths[1] = 0;
            lengths[usize::from(symbol)] = 1;
        }
        return;
    }
    // Rarest first; ties by symbol, so that the result is defined.
    leaves.sort_unstable();

    let mut per_length = huffman_depths(&leaves);
    shorten(&mut per_length, limit);

    let mut length = limit;
    let mut left = per_length[usize::from(limit)];
    for &(_, symbol) in &leaves {
        while left == 0 {
            length -= 1;
            left = per_length[usize::from(length)];
        }
        lengths[usize::from(symbol)] = length;
        left -= 1;
    }
}

/// How many leaves an optimal tree has at each depth (depths beyond 63 need more than 2^44 counts).
fn huffman_depths(leaves: &[(u32, u16)]) -> [u32; 64] {
    let n = leaves.len();
    // Nodes 0..n are the leaves, n.. the inner nodes in the order they are made, which is by weight:
    // two queues instead of a heap.
    let mut inner: Vec<u64> = Vec::with_capacity(n - 1);
    let mut parent = vec![0_u32; 2 * n - 1];
    let (mut leaf, mut node) = (0, 0);
    for made in 0..n - 1 {
        let mut weight = 0;
        for _ in 0..2 {
            let take_leaf = leaf < n && (node >= made || u64::from(leaves[leaf].0) <= inner[node]);
            let child = if take_leaf {
                weight += u64::from(leaves[leaf].0);
                leaf += 1;
                leaf - 1
            } else {
                weight += inner[node];
                node += 1;
                n + node - 1
            };
            parent[child] = (n + made) as u32;
        }
        inner.push(weight);
    }
    let mut depth = vec![0_u8; 2 * n - 1];
    let mut per_length = [0_u32; 64];
    for i in (0..2 * n - 2).rev() {
        depth[i] = depth[parent[i] as usize] + 1;
        if i < n {
            per_length[usize::from(depth[i]).min(63)] += 1;
        }
    }
    per_length
}

/// Moves leaves so that none is deeper than `limit` and the code stays complete.
fn shorten(per_length: &mut [u32; 64], limit: u8) {
    let limit = usize::from(limit);
    let too_deep: u32 = per_length[limit + 1..].iter().sum();
    if too_deep == 0 {
        return;
    }
    per_length[limit + 1..].fill(0);
    per_length[limit] += too_deep;
    // In units of 2^-limit the code may use 2^limit. Hanging a deepest leaf beside a shallower one
    // (which sinks by one level) frees one unit.
    let mut used: u64 = (1..=limit).map(|l| u64::from(per_length[l]) << (limit - l)).sum();
    while used > 1 << limit {
        let Some(shallow) = (1..limit).rev().find(|&l| per_length[l] > 0) else { return };
        per_length[limit] -= 1;
        per_length[shallow] -= 1;
        per_length[shallow + 1] += 2;
        used -= 1;
    }
}

/// Canonical code words of `lengths` (RFC 1951, 3.2.2), bits reversed for writing.
pub(super) fn canonical<const N: usize>(lengths: &[u8; N]) -> [Code; N] {
    let mut per_length = [0_u16; 16];
    for &len in lengths {
        per_length[usize::from(len)] += 1;
    }
    per_length[0] = 0;
    let mut next = [0_u16; 16];
    let mut code = 0_u16;
    for len in 1..16 {
        code = (code + per_length[len - 1]) << 1;
        next[len] = code;
    }
    let mut codes = [Code::default(); N];
    for (code, &len) in codes.iter_mut().zip(lengths) {
        if len > 0 {
            let bits = next[usize::from(len)];
            next[usize::from(len)] += 1;
            *code = Code { bits: bits.reverse_bits() >> (16 - len), len };
        }
    }
    codes
}

/// The part of a dynamic block that describes its codes.
pub(super) struct Header {
    litlen: usize,
    distance: usize,
    stored_lengths: usize,
    length_lengths: [u8; 19],
    /// (symbol, extra bits' value, their number)
    runs: Vec<(u8, u8, u8)>,
    bits: u64,
}

impl Header {
    fn new(litlen: &[u8; LITLEN_SYMBOLS], distance: &[u8; DISTANCE_SYMBOLS]) -> Self {
        let used = |lengths: &[u8], least: usize| {
            lengths.iter().rposition(|&l| l > 0).map_or(least, |last| (last + 1).max(least))
        };
        let (litlen_used, distance_used) = (used(litlen, 257), used(distance, 1));
        // One sequence: a run may cross from the first code into the second.
        let mut all = litlen[..litlen_used].to_vec();
        all.extend_from_slice(&distance[..distance_used]);
        let runs = run_lengths(&all);

        let mut counts = [0_u32; 19];
        for &(symbol, _, _) in &runs {
            counts[usize::from(symbol)] += 1;
        }
        let mut length_lengths = [0_u8; 19];
        code_lengths(&counts, 7, &mut length_lengths);
        let stored_lengths = LENGTH_CODE_ORDER
            .iter()
            .rposition(|&symbol| length_lengths[symbol] > 0)
            .map_or(4, |last| (last + 1).max(4));
        let bits = 14
            + 3 * stored_lengths as u64
            + runs
                .iter()
                .map(|&(symbol, _, extra)| {
                    u64::from(length_lengths[usize::from(symbol)]) + u64::from(extra)
                })
                .sum::<u64>();
        Self {
            litlen: litlen_used,
            distance: distance_used,
            stored_lengths,
            length_lengths,
            runs,
            bits,
        }
    }

    /// Writes everything between the block type and the first symbol.
    pub(super) fn write(&self, out: &mut BitWriter) {
        out.put((self.litlen - 257) as u64, 5);
        out.put((self.distance - 1) as u64, 5);
        out.put((self.stored_lengths - 4) as u64, 4);
        for &symbol in &LENGTH_CODE_ORDER[..self.stored_lengths] {
            out.put(u64::from(self.length_lengths[symbol]), 3);
        }
        let codes = canonical(&self.length_lengths);
        for &(symbol, value, extra) in &self.runs {
            let code = codes[usize::from(symbol)];
            out.put(u64::from(code.bits), u32::from(code.len));
            out.put(u64::from(value), u32::from(extra));
        }
    }
}

/// Code lengths as runs: 16 repeats the last one 3 to 6 times, 17 and 18 repeat zero 3 to 10 and
/// 11 to 138 times.
fn run_lengths(lengths: &[u8]) -> Vec<(u8, u8, u8)> {
    let mut runs = Vec::with_capacity(lengths.len());
    for group in lengths.chunk_by(|a, b| a == b) {
        let value = group[0];
        let mut left = group.len();
        if value == 0 {
            while left >= 3 {
                let take = left.min(138);
                runs.push(if take >= 11 {
                    (18, (take - 11) as u8, 7)
                } else {
                    (17, (take - 3) as u8, 3)
                });
                left -= take;
            }
        } else {
            runs.push((value, 0, 0));
            left -= 1;
            while left >= 3 {
                let take = left.min(6);
                runs.push((16, (take - 3) as u8, 2));
                left -= take;
            }
        }
        runs.extend(std::iter::repeat_n((value, 0, 0), left));
    }
    runs
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn symbols_of_lengths_and_distances_follow_the_tables_of_rfc_1951() {
        for (length, symbol) in
            [(3, 257), (10, 264), (11, 265), (12, 265), (13, 266), (257, 284), (258, 285)]
        {
            assert_eq!(usize::from(LENGTH_SYMBOL[length - 3]) + LENGTH_3, symbol, "{length}");
        }
        for (distance, symbol) in
            [(1, 0), (4, 3), (5, 4), (6, 4), (7, 5), (24_576, 28), (24_577, 29), (32_768, 29)]
        {
            assert_eq!(distance_symbol(distance), symbol, "{distance}");
        }
        for symbol in 0..30 {
            assert_eq!(distance_symbol(distance_base(symbol)), symbol);
        }
    }

    /// The cost of an optimal code, by definition: the sum of all merged weights.
    fn optimal_cost(counts: &[u32]) -> u64 {
        let mut weights: Vec<u64> =
            counts.iter().filter(|&&c| c > 0).map(|&c| u64::from(c)).collect();
        let mut cost = 0;
        while weights.len() > 1 {
            weights.sort_unstable_by(|a, b| b.cmp(a));
            let merged = weights.pop().expect("two") + weights.pop().expect("two");
            cost += merged;
            weights.push(merged);
        }
        cost
    }

    proptest! {
        #[test]
        fn codes_are_complete_and_optimal_where_the_limit_allows(
            counts in prop::collection::vec(prop_oneof![3 => 0..50_u32, 1 => 0..2_000_000_u32], 2..286),
        ) {
            let used = counts.iter().filter(|&&c| c > 0).count();
            let mut lengths = vec![0; counts.len()];
            for limit in [9, CODE_LIMIT, 15] {
                code_lengths(&counts, limit, &mut lengths);
                let kraft: u64 = lengths.iter().filter(|&&l| l > 0).map(|&l| 1 << (15 - l)).sum();
                prop_assert_eq!(kraft, 1 << 15);
                prop_assert!(lengths.iter().all(|&l| l <= limit));
                if used >= 2 {
                    for (&count, &length) in counts.iter().zip(&lengths) {
                        prop_assert_eq!(count > 0, length > 0);
                    }
                    let cost: u64 =
                        counts.iter().zip(&lengths).map(|(&c, &l)| u64::from(c) * u64::from(l)).sum();
                    let best = optimal_cost(&counts);
                    prop_assert!(cost >= best);
                    if limit == 15 && lengths.iter().all(|&l| l < 15) {
                        prop_assert_eq!(cost, best);
                    }
                }
            }
        }

        #[test]
        fn runs_unfold_to_the_lengths(lengths in prop::collection::vec(
            (0..15_u8, 1..200_usize), 0..20)) {
            let lengths: Vec<u8> =
                lengths.into_iter().flat_map(|(l, n)| std::iter::repeat_n(l, n)).collect();
            let mut back: Vec<u8> = Vec::new();
            for (symbol, value, _) in run_lengths(&lengths) {
                let (what, times) = match symbol {
                    16 => (*back.last().expect("a length to repeat"), value + 3),
                    17 => (0, value + 3),
                    18 => (0, value + 11),
                    length => (length, 1),
                };
                back.extend(std::iter::repeat_n(what, usize::from(times)));
            }
            prop_assert_eq!(back, lengths);
        }
    }

    #[test]
    fn the_fixed_code_is_that_of_rfc_1951() {
        let codes = canonical(&FIXED_LITLEN);
        for (symbol, word, len) in [
            (0, 0b0011_0000, 8),
            (143, 0b1011_1111, 8),
            (144, 0b1_1001_0000, 9),
            (255, 0b1_1111_1111, 9),
            (256, 0, 7),
            (279, 0b001_0111, 7),
            (280, 0b1100_0000, 8),
        ] {
            let reversed = u16::reverse_bits(word) >> (16 - len);
            assert_eq!(codes[symbol], Code { bits: reversed, len }, "{symbol}");
        }
    }

    #[test]
    fn fibonacci_counts_are_held_to_the_limit() {
        let mut counts = vec![1_u32, 1];
        while counts.len() < 30 {
            counts.push(counts[counts.len() - 1] + counts[counts.len() - 2]);
        }
        let mut lengths = vec![0; 30];
        code_lengths(&counts, CODE_LIMIT, &mut lengths);
        assert_eq!(lengths.iter().max(), Some(&CODE_LIMIT));
    }
}
