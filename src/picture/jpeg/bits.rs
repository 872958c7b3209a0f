//! Bytes and bits of a JPEG file, and its Huffman codes.

use std::io::Read;

/// What is wrong with the file.
pub(super) type Reason = String;

const BUFFER: usize = 64 * 1024;

/// Reads a file byte by byte between scans and bit by bit within them.
pub(super) struct Bits<R> {
    reader: R,
    buffer: Vec<u8>,
    at: usize,
    /// Bits of the scan that were read and not used, in the lowest places.
    held: u64,
    count: u32,
    /// The marker at which the scan's data end.
    marker: Option<u8>,
    ended: bool,
}

impl<R: Read> Bits<R> {
    pub(super) fn new(reader: R) -> Self {
        Self { reader, buffer: Vec::new(), at: 0, held: 0, count: 0, marker: None, ended: false }
    }

    fn next(&mut self) -> Result<Option<u8>, Reason> {
        if self.at == self.buffer.len() {
            self.buffer.resize(BUFFER, 0);
            let read = loop {
                match self.reader.read(&mut self.buffer) {
                    Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                    other => break other.map_err(|error| error.to_string())?,
                }
            };
            self.buffer.truncate(read);
            self.at = 0;
            if read == 0 {
                return Ok(None);
            }
        }
        self.at += 1;
        Ok(Some(self.buffer[self.at - 1]))
    }

    /// The next byte outside of a scan.
    pub(super) fn byte(&mut self) -> Result<u8, Reason> {
        self.next()?.ok_or_else(|| "the file ends early: it is truncated".to_owned())
    }

    /// Two bytes, the upper one first.
    pub(super) fn word(&mut self) -> Result<u16, Reason> {
        Ok(u16::from_be_bytes([self.byte()?, self.byte()?]))
    }

    /// The content of a segment, without its length.
    pub(super) fn segment(&mut self) -> Result<Vec<u8>, Reason> {
        let length = usize::from(self.word()?);
        let length = length.checked_sub(2).ok_or("a segment states a length below 2")?;
        (0..length).map(|_| self.byte()).collect()
    }

    /// The next marker; what lies before it is passed over, as every reader does.
    pub(super) fn next_marker(&mut self) -> Result<u8, Reason> {
        self.count = 0;
        self.held = 0;
        if let Some(marker) = self.marker.take() {
            return Ok(marker);
        }
        loop {
            if self.byte()? != 0xFF {
                continue;
            }
            let mut code = self.byte()?;
            while code == 0xFF {
                code = self.byte()?;
            }
            if code != 0 {
                return Ok(code);
            }
        }
    }

    /// Puts whole bytes of the scan into `held`, up to its end.
    fn fill(&mut self) -> Result<(), Reason> {
        while self.count <= 48 && self.marker.is_none() && !self.ended {
            let Some(byte) = self.next()? else {
                self.ended = true;
                return Ok(());
            };
            if byte == 0xFF {
                let mut code = 0xFF;
                while code == 0xFF {
                    match self.next()? {
                        Some(next) => code = next,
                        None => {
                            self.ended = true;
                            return Ok(());
                        }
                    }
                }
                if code != 0 {
                    self.marker = Some(code);
                    return Ok(());
                }
            }
            self.held = self.held << 8 | u64::from(byte);
            self.count += 8;
        }
        Ok(())
    }

    /// The next `count` bits (at most 16) without using them; zeros stand for what is not there.
    fn peek(&mut self, count: u32) -> Result<u32, Reason> {
        if self.count < count {
            self.fill()?;
        }
        let bits = if self.count >= count {
            self.held >> (self.count - count)
        } else {
            self.held << (count - self.count)
        };
        Ok(bits as u32 & ((1 << count) - 1))
    }

    fn skip(&mut self, count: u32) -> Result<(), Reason> {
        if self.count < count {
            return Err(if self.ended {
                "the file ends early: it is truncated; copy it again".to_owned()
            } else {
                "the data end early: the file is damaged".to_owned()
            });
        }
        self.count -= count;
        Ok(())
    }

    /// The next `count` bits (at most 16) as a number.
    pub(super) fn bits(&mut self, count: u32) -> Result<i32, Reason> {
        let value = self.peek(count)?;
        self.skip(count)?;
        Ok(value as i32)
    }

    /// A coefficient of `size` bits in JPEG's notation: the lower half of the numbers is negative.
    pub(super) fn signed(&mut self, size: u32) -> Result<i32, Reason> {
        if size == 0 {
            return Ok(0);
        }
        let value = self.bits(size)?;
        Ok(if value < 1 << (size - 1) { value - (1 << size) + 1 } else { value })
    }

    /// The symbol of the next Huffman code.
    pub(super) fn symbol(&mut self, codes: &HuffmanTable) -> Result<u8, Reason> {
        let next = self.peek(16)?;
        let (length, symbol) = codes.fast[(next >> (16 - FAST_BITS)) as usize];
        if length > 0 {
            self.skip(u32::from(length))?;
            return Ok(symbol);
        }
        for length in FAST_BITS + 1..=16 {
            let code = (next >> (16 - length)) as i32;
            let index = length as usize;
            if code <= codes.last[index] {
                self.skip(length)?;
                let at = usize::try_from(code - codes.first[index]).unwrap_or(usize::MAX);
                let symbol =
                    at.checked_add(codes.start[index]).and_then(|at| codes.symbols.get(at));
                return symbol.copied().ok_or_else(|| BAD_CODE.to_owned());
            }
        }
        // Past the end of the data, that is what is wrong.
        if self.count < 16 {
            self.skip(16)?;
        }
        Err(BAD_CODE.to_owned())
    }

    /// Passes over a restart marker, which must be there.
    pub(super) fn restart(&mut self) -> Result<(), Reason> {
        self.fill()?;
        if self.marker.is_none() && self.count >= 8 {
            return Err("a restart marker is missing: the file is damaged".to_owned());
        }
        match self.next_marker()? {
            0xD0..=0xD7 => Ok(()),
            _ => Err("a restart marker is missing: the file is damaged or truncated".to_owned()),
        }
    }
}

const BAD_CODE: &str = "a code of no meaning: the file is damaged";
const FAST_BITS: u32 = 9;

/// One Huffman code.
#[derive(Clone)]
pub(super) struct HuffmanTable {
    /// For each value of the next bits: length of the code that they begin with, and its symbol.
    fast: Vec<(u8, u8)>,
    /// For each length: its first code, its last code (-1 for none), where its symbols start.
    first: [i32; 17],
    last: [i32; 17],
    start: [usize; 17],
    symbols: Vec<u8>,
}

impl HuffmanTable {
    /// From the number of codes of each length and the symbols in their order.
    pub(super) fn new(counts: &[u8; 16], symbols: Vec<u8>) -> Result<Self, Reason> {
        let mut table = Self {
            fast: vec![(0, 0); 1 << FAST_BITS],
            first: [0; 17],
            last: [-1; 17],
            start: [0; 17],
            symbols,
        };
        let (mut code, mut at) = (0_i32, 0_usize);
        for length in 1..=16_usize {
            let count = usize::from(counts[length - 1]);
            table.first[length] = code;
            table.start[length] = at;
            for _ in 0..count {
                if code >= 1 << length {
                    return Err("a Huffman table has more codes than fit".to_owned());
                }
                if length as u32 <= FAST_BITS {
                    let spare = FAST_BITS - length as u32;
                    let from = (code as usize) << spare;
                    table.fast[from..from + (1 << spare)].fill((length as u8, table.symbols[at]));
                }
                code += 1;
                at += 1;
            }
            if count > 0 {
                table.last[length] = code - 1;
            }
            code <<= 1;
        }
        Ok(table)
    }
}
