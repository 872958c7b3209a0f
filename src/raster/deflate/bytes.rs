//! The match finder for any bytes: one probe per position for four equal bytes, greedy.

use super::bits::BitWriter;
use super::huffman::{
    Code, Codes, Counts, DISTANCE_EXTRA, END_OF_BLOCK, LENGTH_3, LENGTH_BASE, LENGTH_EXTRA,
    LENGTH_SYMBOL, distance_base, distance_symbol, plan_block,
};
use super::write_block;

/// Bytes in one block: each has codes of its own.
const BLOCK: usize = 64 * 1024;
const WINDOW: usize = 32 * 1024;
const HASH_BITS: u32 = 14;
const MIN_MATCH: usize = 4;
const MAX_MATCH: usize = 258;

/// A match, after so many literals.
#[derive(Clone, Copy, Debug)]
struct Step {
    literals: u32,
    length: u16,
    distance: u16,
}

#[inline(always)]
fn four_bytes(data: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([data[at], data[at + 1], data[at + 2], data[at + 3]])
}

#[inline(always)]
const fn hash(four: u32) -> usize {
    (four.wrapping_mul(0x9E37_79B1) >> (32 - HASH_BITS)) as usize
}

/// Appends `data` as DEFLATE blocks, the last one marked if `last`.
pub(super) fn deflate(data: &[u8], last: bool, out: &mut BitWriter) {
    // Low 16 bits of the last position with each hash; every candidate is compared.
    let mut heads = vec![0_u16; 1 << HASH_BITS];
    let mut steps = Vec::new();
    for start in (0..data.len()).step_by(BLOCK) {
        let end = (start + BLOCK).min(data.len());
        steps.clear();
        find_matches(data, start, end, &mut heads, &mut steps);
        let mut counts = count(&data[start..end], &steps);
        counts.litlen[END_OF_BLOCK] = 1;
        let plan = plan_block(&counts, end - start);
        write_block(out, &plan, &data[start..end], last && end == data.len(), |codes, out| {
            write_steps(&data[start..end], &steps, codes, out);
        });
    }
}

fn find_matches(data: &[u8], start: usize, end: usize, heads: &mut [u16], steps: &mut Vec<Step>) {
    let data = &data[..end];
    let (mut at, mut literals_from) = (start, start);
    while at + MIN_MATCH <= end {
        let four = four_bytes(data, at);
        let head = &mut heads[hash(four)];
        let distance = usize::from((at as u16).wrapping_sub(*head));
        *head = at as u16;
        if distance.wrapping_sub(1) < WINDOW
            && distance <= at
            && four_bytes(data, at - distance) == four
        {
            let most = MAX_MATCH.min(end - at);
            let length = data[at + MIN_MATCH..at + most]
                .iter()
                .zip(&data[at + MIN_MATCH - distance..])
                .take_while(|(a, b)| a == b)
                .count()
                + MIN_MATCH;
            let literals = (at - literals_from) as u32;
            steps.push(Step { literals, length: length as u16, distance: distance as u16 });
            // Later data reaches into the match through its last positions.
            let tail = (at + length).saturating_sub(3).max(at + 1);
            for i in tail..(at + length).min(end.saturating_sub(3)) {
                heads[hash(four_bytes(data, i))] = i as u16;
            }
            at += length;
            literals_from = at;
        } else {
            // The longer nothing matches, the wider the steps: noise costs little time.
            at += 1 + ((at - literals_from) >> 9);
        }
    }
}

fn count(block: &[u8], steps: &[Step]) -> Counts {
    let mut counts = Counts::new();
    let mut literals = [[0_u32; 256]; 4];
    let mut count_literals = |bytes: &[u8]| {
        let (fours, rest) = bytes.as_chunks::<4>();
        for four in fours {
            for (table, &byte) in literals.iter_mut().zip(four) {
                table[usize::from(byte)] += 1;
            }
        }
        for &byte in rest {
            literals[0][usize::from(byte)] += 1;
        }
    };
    let mut at = 0;
    for step in steps {
        count_literals(&block[at..at + step.literals as usize]);
        at += step.literals as usize + usize::from(step.length);
        let symbol = usize::from(LENGTH_SYMBOL[usize::from(step.length) - 3]);
        counts.litlen[LENGTH_3 + symbol] += 1;
        counts.distance[distance_symbol(u32::from(step.distance)) as usize] += 1;
    }
    count_literals(&block[at..]);
    for (i, count) in counts.litlen[..256].iter_mut().enumerate() {
        *count = literals.iter().map(|l| l[i]).sum();
    }
    counts
}

fn write_steps(block: &[u8], steps: &[Step], codes: &Codes, out: &mut BitWriter) {
    let literal: [Code; 256] = std::array::from_fn(|i| codes.litlen[i]);
    let write_literals = |bytes: &[u8], out: &mut BitWriter| {
        let (fours, rest) = bytes.as_chunks::<4>();
        for four in fours {
            let [a, b, c, d] = four.map(|byte| literal[usize::from(byte)]);
            let low = u64::from(a.bits) | u64::from(b.bits) << a.len;
            let high = u64::from(c.bits) | u64::from(d.bits) << c.len;
            let low_len = u32::from(a.len + b.len);
            out.put(low | high << low_len, low_len + u32::from(c.len + d.len));
        }
        for &byte in rest {
            let code = literal[usize::from(byte)];
            out.put(u64::from(code.bits), u32::from(code.len));
        }
    };
    let mut at = 0;
    for step in steps {
        write_literals(&block[at..at + step.literals as usize], out);
        at += step.literals as usize + usize::from(step.length);
        let symbol = usize::from(LENGTH_SYMBOL[usize::from(step.length) - 3]);
        let code = codes.litlen[LENGTH_3 + symbol];
        let extra = u64::from(step.length - LENGTH_BASE[symbol]);
        out.put(
            u64::from(code.bits) | extra << code.len,
            u32::from(code.len + LENGTH_EXTRA[symbol]),
        );
        let symbol = distance_symbol(u32::from(step.distance));
        let code = codes.distance[symbol as usize];
        let extra = u64::from(u32::from(step.distance) - distance_base(symbol));
        out.put(
            u64::from(code.bits) | extra << code.len,
            u32::from(code.len + DISTANCE_EXTRA[symbol as usize]),
        );
    }
    write_literals(&block[at..], out);
}
