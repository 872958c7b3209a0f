//! Coefficients of one block, in each of the kinds of scan that JPEG has.

use super::bits::{Bits, HuffmanTable, Reason};
use std::io::Read;

/// Where the coefficients of a scan belong in a row-major block.
pub(super) const ZIGZAG: [u8; 64] = [
    0, 1, 8, 16, 9, 2, 3, 10, 17, 24, 32, 25, 18, 11, 4, 5, 12, 19, 26, 33, 40, 48, 41, 34, 27, 20,
    13, 6, 7, 14, 21, 28, 35, 42, 49, 56, 57, 50, 43, 36, 29, 22, 15, 23, 30, 37, 44, 51, 58, 59,
    52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63,
];

/// What a scan holds of each block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Band {
    /// First and last coefficient, in zigzag order.
    pub(super) first: usize,
    pub(super) last: usize,
    /// The bit that an earlier scan ended at (0: there was none), and the one that this one ends at.
    pub(super) high: u32,
    pub(super) low: u32,
}

/// What goes from block to block.
#[derive(Clone, Debug, Default)]
pub(super) struct Memory {
    /// The last constant coefficient of each component.
    pub(super) constants: [i32; 4],
    /// Blocks still to come that hold nothing more.
    pub(super) empty_blocks: i32,
}

const TOO_FAR: &str = "a coefficient beyond its block: the file is damaged";

/// A whole block of a sequential scan.
pub(super) fn sequential<R: Read>(
    bits: &mut Bits<R>,
    constant: &HuffmanTable,
    waves: &HuffmanTable,
    before: &mut i32,
    block: &mut [i16; 64],
) -> Result<(), Reason> {
    let size = u32::from(bits.symbol(constant)?);
    *before = before.wrapping_add(bits.signed(check_size(size)?)?);
    block[0] = *before as i16;
    let mut at = 1;
    while at < 64 {
        let symbol = bits.symbol(waves)?;
        let (run, size) = (usize::from(symbol >> 4), u32::from(symbol & 15));
        if size == 0 {
            if run < 15 {
                break;
            }
            at += 16;
            continue;
        }
        at += run;
        let value = bits.signed(size)?;
        let place = ZIGZAG.get(at).ok_or(TOO_FAR)?;
        block[usize::from(*place)] = value as i16;
        at += 1;
    }
    Ok(())
}

fn check_size(size: u32) -> Result<u32, Reason> {
    if size <= 15 { Ok(size) } else { Err("a coefficient of more than 15 bits".to_owned()) }
}

/// A block's constant coefficient in a progressive scan.
pub(super) fn progressive_constant<R: Read>(
    bits: &mut Bits<R>,
    table: Option<&HuffmanTable>,
    band: Band,
    before: &mut i32,
    block: &mut [i16; 64],
) -> Result<(), Reason> {
    match table {
        Some(table) if band.high == 0 => {
            let size = u32::from(bits.symbol(table)?);
            *before = before.wrapping_add(bits.signed(check_size(size)?)?);
            block[0] = before.wrapping_shl(band.low) as i16;
        }
        _ => {
            if bits.bits(1)? == 1 {
                block[0] |= 1 << band.low;
            }
        }
    }
    Ok(())
}

/// A block's other coefficients in the first progressive scan of their band.
pub(super) fn progressive_first<R: Read>(
    bits: &mut Bits<R>,
    waves: &HuffmanTable,
    band: Band,
    memory: &mut Memory,
    block: &mut [i16; 64],
) -> Result<(), Reason> {
    if memory.empty_blocks > 0 {
        memory.empty_blocks -= 1;
        return Ok(());
    }
    let mut at = band.first;
    while at <= band.last {
        let symbol = bits.symbol(waves)?;
        let (run, size) = (u32::from(symbol >> 4), u32::from(symbol & 15));
        if size == 0 {
            if run < 15 {
                memory.empty_blocks = (1 << run) - 1 + bits.bits(run)?;
                break;
            }
            at += 16;
            continue;
        }
        at += run as usize;
        let value = bits.signed(size)?;
        let place = ZIGZAG.get(at).ok_or(TOO_FAR)?;
        block[usize::from(*place)] = value.wrapping_shl(band.low) as i16;
        at += 1;
    }
    Ok(())
}

/// One more bit of a block's other coefficients.
pub(super) fn progressive_refine<R: Read>(
    bits: &mut Bits<R>,
    waves: &HuffmanTable,
    band: Band,
    memory: &mut Memory,
    block: &mut [i16; 64],
) -> Result<(), Reason> {
    let bit = 1_i16 << band.low;
    let mut at = band.first;
    if memory.empty_blocks == 0 {
        while at <= band.last {
            let symbol = bits.symbol(waves)?;
            let (mut run, size) = (i32::from(symbol >> 4), symbol & 15);
            let mut value = 0;
            match size {
                0 if run < 15 => {
                    memory.empty_blocks = (1 << run) + bits.bits(run as u32)?;
                    break;
                }
                0 => {}
                1 => value = if bits.bits(1)? == 1 { bit } else { -bit },
                _ => return Err("a refinement of more than one bit".to_owned()),
            }
            // Coefficients that are there get their bit; `run` others stay zero.
            while at <= band.last {
                let coefficient = &mut block[usize::from(ZIGZAG[at])];
                if *coefficient != 0 {
                    refine(bits, coefficient, bit)?;
                } else if run == 0 {
                    *coefficient = value;
                    at += 1;
                    break;
                } else {
                    run -= 1;
                }
                at += 1;
            }
        }
    }
    if memory.empty_blocks > 0 {
        for place in &ZIGZAG[at.min(64)..=band.last] {
            let coefficient = &mut block[usize::from(*place)];
            if *coefficient != 0 {
                refine(bits, coefficient, bit)?;
            }
        }
        memory.empty_blocks -= 1;
    }
    Ok(())
}

fn refine<R: Read>(bits: &mut Bits<R>, coefficient: &mut i16, bit: i16) -> Result<(), Reason> {
    if bits.bits(1)? == 1 && *coefficient & bit == 0 {
        *coefficient = coefficient.wrapping_add(if *coefficient > 0 { bit } else { -bit });
    }
    Ok(())
}
