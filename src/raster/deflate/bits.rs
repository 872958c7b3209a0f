//! Writing bits, least significant first, through a 64-bit accumulator.

/// A growing byte string to which bits are appended.
#[derive(Debug)]
pub(super) struct BitWriter {
    /// Bytes written, then scratch space that later writes overwrite.
    bytes: Vec<u8>,
    /// Number of bytes written.
    len: usize,
    /// Bits not written yet, fewer than 8 between calls.
    pending: u64,
    count: u32,
}

impl BitWriter {
    pub(super) fn with_capacity(capacity: usize) -> Self {
        Self { bytes: Vec::with_capacity(capacity), len: 0, pending: 0, count: 0 }
    }

    /// Makes room for `bits` more bits, so that [`put`](Self::put) need not grow.
    pub(super) fn reserve_bits(&mut self, bits: u64) {
        let wanted = self.len + (bits / 8) as usize + 24;
        if self.bytes.len() < wanted {
            self.bytes.resize(wanted, 0);
        }
    }

    /// Appends the low `count` bits of `bits` (at most 56; the bits above must be zero). Room must
    /// have been made with [`reserve_bits`](Self::reserve_bits).
    #[inline(always)]
    pub(super) fn put(&mut self, bits: u64, count: u32) {
        debug_assert!(count <= 56 && bits >> count == 0);
        self.pending |= bits << self.count;
        self.count += count;
        self.bytes[self.len..self.len + 8].copy_from_slice(&self.pending.to_le_bytes());
        self.len += (self.count >> 3) as usize;
        self.pending >>= self.count & !7;
        self.count &= 7;
    }

    /// Pads with zero bits to a whole byte.
    pub(super) fn align(&mut self) {
        self.reserve_bits(8);
        self.put(0, (8 - self.count) & 7);
    }

    /// Appends whole bytes; must be aligned.
    pub(super) fn put_bytes(&mut self, bytes: &[u8]) {
        debug_assert_eq!(self.count, 0);
        self.bytes.truncate(self.len);
        self.bytes.extend_from_slice(bytes);
        self.len = self.bytes.len();
    }

    /// The bytes, the last one padded with zero bits.
    pub(super) fn finish(mut self) -> Vec<u8> {
        self.align();
        self.bytes.truncate(self.len);
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_come_out_least_significant_first() {
        let mut out = BitWriter::with_capacity(0);
        out.reserve_bits(64);
        out.put(0b1, 1);
        out.put(0b01, 2);
        out.put(0b1_0110, 5);
        out.put(0x000f_ffff_ffff_ffff, 52);
        out.align();
        out.put_bytes(b"ab");
        assert_eq!(
            out.finish(),
            [0b1011_0011, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x0f, b'a', b'b']
        );
    }
}
