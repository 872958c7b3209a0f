//! The part of the zip format that numpy uses.

use super::Reason;
use crate::raster::deflate::{Compression, Samples, deflate, inflate, inflate_beginning};

const LOCAL: u32 = 0x0403_4b50;
const CENTRAL: u32 = 0x0201_4b50;
const END: u32 = 0x0605_4b50;
const END_64_LOCATOR: u32 = 0x0706_4b50;
const END_64: u32 = 0x0606_4b50;
const ZIP64_FIELD: u16 = 1;
const STORED: u16 = 0;
const DEFLATED: u16 = 8;
/// 1980-01-01, the earliest date of the format and the one that numpy writes.
const DATE: u16 = (1 << 5) | 1;

/// What does not fit 32 bits is written as this, and stands in a zip64 field instead.
const IN_ZIP64: u32 = u32::MAX;

/// An archive being written.
pub(super) struct Writer {
    bytes: Vec<u8>,
    central: Vec<u8>,
    count: u64,
    /// Sizes and offsets from here on go into zip64 fields; 2^32 - 1 but in tests.
    zip64_from: u64,
}

impl Writer {
    pub(super) const fn new() -> Self {
        Self { bytes: Vec::new(), central: Vec::new(), count: 0, zip64_from: IN_ZIP64 as u64 }
    }

    #[cfg(test)]
    pub(super) fn with_zip64_from(zip64_from: u64) -> Self {
        Self { zip64_from, ..Self::new() }
    }

    /// Appends a member whose content is made of items of `item_bytes` bytes.
    pub(super) fn add(
        &mut self,
        name: &str,
        content: &[u8],
        item_bytes: usize,
        compression: Compression,
    ) {
        let samples = if item_bytes == 4 { Samples::Words32 } else { Samples::Bytes };
        let (method, packed) = match compression {
            Compression::Stored => (STORED, None),
            _ => (DEFLATED, Some(deflate(content, samples, compression))),
        };
        let packed = packed.as_deref().unwrap_or(content);
        let crc = crc32fast::hash(content);
        let (size, packed_size) = (content.len() as u64, packed.len() as u64);
        let offset = self.bytes.len() as u64;
        // The local header has both sizes in zip64 or neither, the central one only what needs it.
        let wide = |n: u64| n >= self.zip64_from;
        let both = wide(size) || wide(packed_size);
        let local = if both { vec![size, packed_size] } else { vec![] };
        let central: Vec<u64> =
            local.iter().copied().chain(wide(offset).then_some(offset)).collect();
        let narrow = |n: u64, in_zip64: bool| if in_zip64 { IN_ZIP64 } else { n as u32 };
        // numpy's names are short; one of 64 kB is cut rather than written wrongly.
        let name = &name.as_bytes()[..name.len().min(60_000)];
        // Flag 11: the name is UTF-8.
        let flags: u16 = if name.is_ascii() { 0 } else { 1 << 11 };
        let header = |extra: &[u64]| {
            // 4.5 of the format brought zip64.
            let version: u16 = if extra.is_empty() { 20 } else { 45 };
            let mut header = Vec::with_capacity(26);
            for field in [version, flags, method, 0, DATE] {
                header.extend_from_slice(&field.to_le_bytes());
            }
            for field in [crc, narrow(packed_size, both), narrow(size, both)] {
                header.extend_from_slice(&field.to_le_bytes());
            }
            header.extend_from_slice(&(name.len() as u16).to_le_bytes());
            let extra_len = if extra.is_empty() { 0 } else { 4 + 8 * extra.len() as u16 };
            header.extend_from_slice(&extra_len.to_le_bytes());
            header
        };
        let append_extra = |out: &mut Vec<u8>, extra: &[u64]| {
            if !extra.is_empty() {
                out.extend_from_slice(&ZIP64_FIELD.to_le_bytes());
                out.extend_from_slice(&(8 * extra.len() as u16).to_le_bytes());
                extra.iter().for_each(|n| out.extend_from_slice(&n.to_le_bytes()));
            }
        };

        self.bytes.reserve(64 + name.len() + packed.len());
        self.bytes.extend_from_slice(&LOCAL.to_le_bytes());
        self.bytes.extend_from_slice(&header(&local));
        self.bytes.extend_from_slice(name);
        append_extra(&mut self.bytes, &local);
        self.bytes.extend_from_slice(packed);

        self.central.extend_from_slice(&CENTRAL.to_le_bytes());
        // Made by version 4.5 on Unix, with rw-r--r-- as the file mode below.
        self.central.extend_from_slice(&[45, 3]);
        self.central.extend_from_slice(&header(&central));
        // Comment length, disk, internal attributes.
        self.central.extend_from_slice(&[0; 6]);
        self.central.extend_from_slice(&(0o100_644_u32 << 16).to_le_bytes());
        self.central.extend_from_slice(&narrow(offset, wide(offset)).to_le_bytes());
        self.central.extend_from_slice(name);
        append_extra(&mut self.central, &central);
        self.count += 1;
    }

    pub(super) fn finish(self) -> Vec<u8> {
        let Self { mut bytes, central, count, zip64_from } = self;
        let (offset, size) = (bytes.len() as u64, central.len() as u64);
        bytes.extend_from_slice(&central);
        let zip64 = offset.max(size) >= zip64_from || count >= u64::from(u16::MAX);
        if zip64 {
            let record = bytes.len() as u64;
            bytes.extend_from_slice(&END_64.to_le_bytes());
            // Size of the rest of the record, made by and needed versions, disks.
            bytes.extend_from_slice(&44_u64.to_le_bytes());
            bytes.extend_from_slice(&[45, 3, 45, 0]);
            bytes.extend_from_slice(&[0; 8]);
            for field in [count, count, size, offset] {
                bytes.extend_from_slice(&field.to_le_bytes());
            }
            bytes.extend_from_slice(&END_64_LOCATOR.to_le_bytes());
            bytes.extend_from_slice(&[0; 4]);
            bytes.extend_from_slice(&record.to_le_bytes());
            bytes.extend_from_slice(&1_u32.to_le_bytes());
        }
        let narrow = |n: u64| if zip64 { IN_ZIP64 } else { n as u32 };
        let count = if zip64 { u16::MAX } else { count as u16 };
        bytes.extend_from_slice(&END.to_le_bytes());
        bytes.extend_from_slice(&[0; 4]);
        bytes.extend_from_slice(&count.to_le_bytes());
        bytes.extend_from_slice(&count.to_le_bytes());
        bytes.extend_from_slice(&narrow(size).to_le_bytes());
        bytes.extend_from_slice(&narrow(offset).to_le_bytes());
        bytes.extend_from_slice(&[0; 2]);
        bytes
    }
}

/// A member of an archive, as the central directory describes it.
#[derive(Debug)]
pub(super) struct Entry {
    pub(super) name: String,
    method: u16,
    encrypted: bool,
    crc: u32,
    packed: u64,
    size: u64,
    offset: u64,
}

/// Little-endian fields read one after another.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    /// The bytes from `offset` on.
    fn at(bytes: &'a [u8], offset: u64) -> Option<Self> {
        Some(Self(bytes.get(usize::try_from(offset).ok()?..)?))
    }

    fn take(&mut self, len: usize) -> Option<&'a [u8]> {
        let (head, tail) = self.0.split_at_checked(len)?;
        self.0 = tail;
        Some(head)
    }

    fn number<const N: usize>(&mut self) -> Option<u64> {
        let mut wide = [0; 8];
        wide[..N].copy_from_slice(self.take(N)?);
        Some(u64::from_le_bytes(wide))
    }

    fn u16(&mut self) -> Option<u16> {
        self.number::<2>().map(|n| n as u16)
    }

    fn u32(&mut self) -> Option<u32> {
        self.number::<4>().map(|n| n as u32)
    }

    fn u64(&mut self) -> Option<u64> {
        self.number::<8>()
    }
}

/// Lists the members of an archive.
pub(super) fn entries(bytes: &[u8]) -> Result<Vec<Entry>, Reason> {
    if bytes.is_empty() {
        return Err("the file is empty".to_owned());
    }
    let no_archive =
        || "neither an npz (zip) archive nor an npy file, or cut off at its end".to_owned();
    let end = end_of_central_directory(bytes).ok_or_else(no_archive)?;
    let (count, offset) =
        directory(bytes, end).ok_or("the end of the archive is damaged".to_owned())?;
    let mut fields =
        Fields::at(bytes, offset).ok_or("the archive's directory lies beyond the file")?;
    // Each entry takes at least 46 bytes: a false count cannot take memory.
    let mut entries = Vec::with_capacity((count as usize).min(bytes.len() / 46));
    for number in 0..count {
        let entry = entry(&mut fields)
            .ok_or_else(|| format!("entry {} of the archive's directory is damaged", number + 1))?;
        entries.push(entry);
    }
    Ok(entries)
}

/// Position of the end record: the last one whose comment fits the file.
fn end_of_central_directory(bytes: &[u8]) -> Option<usize> {
    let last = bytes.len().checked_sub(22)?;
    (last.saturating_sub(65_535)..=last).rev().find(|&at| {
        bytes[at..].starts_with(&END.to_le_bytes())
            && usize::from(u16::from_le_bytes([bytes[at + 20], bytes[at + 21]])) == last - at
    })
}

/// Number of entries and offset of the central directory.
fn directory(bytes: &[u8], end: usize) -> Option<(u64, u64)> {
    let mut fields = Fields(&bytes[end + 10..]);
    let count = u64::from(fields.u16()?);
    let _size = fields.u32()?;
    let offset = u64::from(fields.u32()?);
    // zip64: a locator stands right before the end record.
    let locator = end.checked_sub(20).and_then(|at| Fields::at(bytes, at as u64));
    let Some(mut locator) = locator else { return Some((count, offset)) };
    if locator.u32()? != END_64_LOCATOR {
        return Some((count, offset));
    }
    let _disk = locator.u32()?;
    let mut record = Fields::at(bytes, locator.u64()?)?;
    if record.u32()? != END_64 {
        return None;
    }
    // Record size, versions, disks, entries on this disk.
    record.take(8 + 4 + 8 + 8)?;
    let count = record.u64()?;
    let _size = record.u64()?;
    Some((count, record.u64()?))
}

fn entry(fields: &mut Fields<'_>) -> Option<Entry> {
    if fields.u32()? != CENTRAL {
        return None;
    }
    fields.take(4)?;
    let flags = fields.u16()?;
    let method = fields.u16()?;
    fields.take(4)?;
    let crc = fields.u32()?;
    let (mut packed, mut size) = (u64::from(fields.u32()?), u64::from(fields.u32()?));
    let (name, extra, comment) = (fields.u16()?, fields.u16()?, fields.u16()?);
    fields.take(8)?;
    let mut offset = u64::from(fields.u32()?);
    let name = String::from_utf8_lossy(fields.take(name.into())?).into_owned();
    let mut extra = Fields(fields.take(extra.into())?);
    fields.take(comment.into())?;
    while let (Some(id), Some(len)) = (extra.u16(), extra.u16()) {
        let mut field = Fields(extra.take(len.into())?);
        if id == ZIP64_FIELD {
            // zip64: only the values that overflow are here, in this order.
            for value in [&mut size, &mut packed, &mut offset] {
                if *value == u64::from(IN_ZIP64) {
                    *value = field.u64()?;
                }
            }
        }
    }
    Some(Entry { name, method, encrypted: flags & 1 != 0, crc, packed, size, offset })
}

impl Entry {
    /// The decompressed content, its checksum verified.
    pub(super) fn content(&self, file: &[u8]) -> Result<Vec<u8>, Reason> {
        if self.encrypted {
            return Err("it is encrypted".to_owned());
        }
        let packed = self.packed_bytes(file).ok_or("its data lies beyond the end of the file")?;
        let size = usize::try_from(self.size).map_err(|_| "it is too large for this machine")?;
        let content = match self.method {
            STORED if packed.len() == size => packed.to_vec(),
            STORED => return Err("its two sizes disagree".to_owned()),
            DEFLATED => inflate(packed, size)?,
            other => {
                return Err(format!(
                    "it is compressed by zip method {other}; save it with numpy.savez or numpy.savez_compressed"
                ));
            }
        };
        if crc32fast::hash(&content) != self.crc {
            return Err("its checksum is wrong: the file is damaged".to_owned());
        }
        Ok(content)
    }

    /// Where the member begins in the file.
    pub(super) const fn offset(&self) -> u64 {
        self.offset
    }

    /// The first bytes of the content, from at most `most` packed ones; not verified.
    pub(super) fn beginning(&self, file: &[u8], most: usize) -> Option<Vec<u8>> {
        let packed = self.packed_bytes(file).filter(|_| !self.encrypted)?;
        let packed = &packed[..packed.len().min(most)];
        match self.method {
            STORED => Some(packed.to_vec()),
            DEFLATED => Some(inflate_beginning(packed, most / 2)),
            _ => None,
        }
    }

    fn packed_bytes<'a>(&self, file: &'a [u8]) -> Option<&'a [u8]> {
        let mut local = Fields::at(file, self.offset)?;
        if local.u32()? != LOCAL {
            return None;
        }
        local.take(22)?;
        let (name, extra) = (local.u16()?, local.u16()?);
        local.take(usize::from(name) + usize::from(extra))?;
        local.take(usize::try_from(self.packed).ok()?)
    }
}
