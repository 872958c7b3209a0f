//! JPEG row by row, in pure Rust.
//!
//! A decoder of our own for two reasons: the ones that there are hold the whole picture, and both
//! builds are to read the same pixels. Its arithmetic is the Independent JPEG Group's, so that the
//! pixels are those of Pillow and GDAL too. Sequential and progressive Huffman coding with 8 bits,
//! which is what cameras, tile servers and programs write.

mod bits;
mod component;
mod scan;
mod transform;

use super::source::RowSource;
use bits::{Bits, HuffmanTable, Reason};
use component::{ColourNotes, Component};
use scan::{Band, Memory, ZIGZAG};
use std::fs::File;
use transform::Upsample;

/// What a scan's header says: the components with their constant and other codes, and the band.
#[derive(Clone, Debug)]
struct Scan {
    components: Vec<(usize, usize, usize)>,
    band: Band,
}

/// A JPEG picture, read from the top.
pub(super) struct JpegRows {
    bits: Bits<File>,
    pub(super) width: u32,
    pub(super) height: u32,
    /// Whether its coefficients have to be held as a whole.
    pub(super) whole: bool,
    progressive: bool,
    is_rgb: bool,
    units: [usize; 2],
    restart_interval: usize,
    quantisation: [Option<[u16; 64]>; 4],
    constants: [Option<HuffmanTable>; 4],
    waves: [Option<HuffmanTable>; 4],
    components: Vec<Component>,
    /// The scan that is read row by row.
    scan: Scan,
    memory: Memory,
    units_done: usize,
    unit_row: usize,
    loaded: bool,
    next_row: usize,
    full: Vec<Vec<u8>>,
}

impl JpegRows {
    /// Reads everything up to the first scan. `memory_limit` is what a picture may take that has to be
    /// held as a whole.
    pub(super) fn open(file: File, memory_limit: u64) -> Result<Self, Reason> {
        let mut rows = Self {
            bits: Bits::new(file),
            width: 0,
            height: 0,
            whole: false,
            progressive: false,
            is_rgb: false,
            units: [0; 2],
            restart_interval: 0,
            quantisation: [None; 4],
            constants: [const { None }; 4],
            waves: [const { None }; 4],
            components: Vec::new(),
            scan: Scan {
                components: Vec::new(),
                band: Band { first: 0, last: 63, high: 0, low: 0 },
            },
            memory: Memory::default(),
            units_done: 0,
            unit_row: 0,
            loaded: false,
            next_row: 0,
            full: Vec::new(),
        };
        let mut colours = ColourNotes::default();
        let found = rows.read_until_scan(&mut colours)?;
        rows.scan = found.ok_or("the file ends before its picture begins")?;
        rows.is_rgb = colours.is_rgb(&rows.components);
        rows.whole = rows.progressive || rows.scan.components.len() < rows.components.len();
        if rows.whole {
            let blocks: usize = rows.components.iter().map(|c| c.blocks[0] * c.blocks[1]).sum();
            let bytes = blocks as u64 * 128;
            if bytes > memory_limit {
                return Err(format!(
                    "is a progressive JPEG of {} x {} pixels, which takes {bytes} bytes to read, and \
                     {memory_limit} are allowed; write it as a sequential one (jpegtran in.jpg > out.jpg) \
                     or as a tiled GeoTIFF",
                    rows.width, rows.height
                ));
            }
        }
        rows.full = vec![Vec::new(); rows.components.len()];
        Ok(rows)
    }

    /// Reads segments up to the next scan's data; `None` at the end of the picture.
    fn read_until_scan(&mut self, colours: &mut ColourNotes) -> Result<Option<Scan>, Reason> {
        loop {
            match self.bits.next_marker()? {
                0xD8 | 0x01 | 0xD0..=0xD7 => {}
                0xD9 => return Ok(None),
                0xC4 => self.huffman_tables()?,
                0xDB => self.quantisation_tables()?,
                kind @ (0xC0..=0xC2) => {
                    if !self.components.is_empty() {
                        return Err("holds two pictures in one".to_owned());
                    }
                    self.progressive = kind == 0xC2;
                    self.frame()?;
                }
                kind @ (0xC3 | 0xC5..=0xC7 | 0xC9..=0xCB | 0xCD..=0xCF) => {
                    return Err(format!(
                        "uses a kind of JPEG that is not read (SOF{}: lossless, hierarchical or arithmetic \
                         coding); write it as an ordinary JPEG or as PNG",
                        kind - 0xC0
                    ));
                }
                0xDD => {
                    let data = self.bits.segment()?;
                    let [high, low] = data[..] else {
                        return Err("a restart interval of another size than 2 bytes".to_owned());
                    };
                    self.restart_interval = usize::from(u16::from_be_bytes([high, low]));
                }
                0xDA => return self.scan_header().map(Some),
                kind @ (0xE0 | 0xEE) => colours.segment(kind, &self.bits.segment()?),
                _ => {
                    self.bits.segment()?;
                }
            }
        }
    }

    fn huffman_tables(&mut self) -> Result<(), Reason> {
        let data = self.bits.segment()?;
        let mut rest = &data[..];
        while let Some((&kind, after)) = rest.split_first() {
            let short = "a Huffman table is cut short";
            let (counts, after) = after.split_first_chunk::<16>().ok_or(short)?;
            let count = counts.iter().map(|n| usize::from(*n)).sum();
            let (symbols, after) = after.split_at_checked(count).ok_or(short)?;
            let tables = if kind >> 4 == 0 { &mut self.constants } else { &mut self.waves };
            let place = tables.get_mut(usize::from(kind & 15)).ok_or("a fifth Huffman table")?;
            *place = Some(HuffmanTable::new(counts, symbols.to_vec())?);
            rest = after;
        }
        Ok(())
    }

    fn quantisation_tables(&mut self) -> Result<(), Reason> {
        let data = self.bits.segment()?;
        let mut rest = &data[..];
        while let Some((&kind, after)) = rest.split_first() {
            let size = if kind >> 4 == 0 { 64 } else { 128 };
            let (values, after) =
                after.split_at_checked(size).ok_or("a quantisation table is cut short")?;
            let mut table = [0; 64];
            for (i, place) in ZIGZAG.into_iter().enumerate() {
                table[usize::from(place)] = if size == 64 {
                    u16::from(values[i])
                } else {
                    u16::from_be_bytes([values[2 * i], values[2 * i + 1]])
                };
            }
            let place = self
                .quantisation
                .get_mut(usize::from(kind & 15))
                .ok_or("a fifth quantisation table")?;
            *place = Some(table);
            rest = after;
        }
        Ok(())
    }

    fn frame(&mut self) -> Result<(), Reason> {
        let data = self.bits.segment()?;
        let short = "the frame header is cut short";
        let (&[bits, h1, h0, w1, w0, count], rest) = data.split_first_chunk().ok_or(short)?;
        if bits != 8 {
            return Err(format!("holds samples of {bits} bits; write it with 8"));
        }
        let (width, height) = (u16::from_be_bytes([w1, w0]), u16::from_be_bytes([h1, h0]));
        if width == 0 || height == 0 {
            return Err(format!("has zero size ({width} x {height} pixels)"));
        }
        (self.width, self.height) = (u32::from(width), u32::from(height));
        if !matches!(count, 1 | 3) {
            return Err(format!(
                "holds {count} colour components (CMYK, perhaps); write it as RGB, for example with \
                 Pillow's convert(\"RGB\")"
            ));
        }
        if rest.len() < usize::from(count) * 3 {
            return Err(short.to_owned());
        }
        let parts = rest.chunks_exact(3).take(usize::from(count));
        let factors: Vec<_> =
            parts.clone().map(|p| [p[1] >> 4, p[1] & 15].map(usize::from)).collect();
        if factors.iter().flatten().any(|factor| !(1..=4).contains(factor)) {
            return Err("states sampling factors that are not 1 to 4".to_owned());
        }
        let most = |axis: usize| factors.iter().map(|f| f[axis]).max().unwrap_or(1);
        let [across, down] = [most(0), most(1)];
        let (width, height) = (usize::from(width), usize::from(height));
        self.units = [width.div_ceil(8 * across), height.div_ceil(8 * down)];
        for (part, [x, y]) in parts.zip(factors) {
            if across % x > 0 || down % y > 0 {
                return Err(format!("states sampling factors {x} x {y} of {across} x {down}"));
            }
            // A component by itself is not interleaved, whatever its factors are.
            let own_width = (width * x).div_ceil(across);
            self.components.push(Component {
                id: part[0],
                across: x,
                down: y,
                table: usize::from(part[2]),
                quantisation: None,
                width: own_width,
                height: (height * y).div_ceil(down),
                blocks: [self.units[0] * x, self.units[1] * y],
                upsample: Upsample::of(across / x, down / y, own_width),
                rows_per_row: down / y,
                coefficients: Vec::new(),
                samples: Vec::new(),
                first_row: 0,
            });
        }
        Ok(())
    }

    fn scan_header(&mut self) -> Result<Scan, Reason> {
        let data = self.bits.segment()?;
        let short = "a scan's header is cut short";
        let (&count, rest) = data.split_first().ok_or(short)?;
        let (parts, rest) = rest.split_at_checked(2 * usize::from(count)).ok_or(short)?;
        let &[first, last, bits] = rest else { return Err(short.to_owned()) };
        let mut components: Vec<(usize, usize, usize)> = Vec::new();
        for part in parts.chunks_exact(2) {
            let index = self.components.iter().position(|c| c.id == part[0]);
            let index = index.ok_or("a scan of a component that there is not")?;
            if components.iter().any(|(other, ..)| *other == index) {
                return Err("a scan that names a component twice".to_owned());
            }
            let component = &mut self.components[index];
            if component.quantisation.is_none() {
                let table = self.quantisation.get(component.table).copied().flatten();
                component.quantisation = Some(table.ok_or("a quantisation table is missing")?);
            }
            components.push((index, usize::from(part[1] >> 4), usize::from(part[1] & 15)));
        }
        let band = if self.progressive {
            Band {
                first: usize::from(first),
                last: usize::from(last),
                high: u32::from(bits >> 4),
                low: u32::from(bits & 15),
            }
        } else {
            Band { first: 0, last: 63, high: 0, low: 0 }
        };
        let sound = band.last < 64
            && band.low < 14
            && if band.first == 0 {
                !self.progressive || band.last == 0
            } else {
                band.first <= band.last && components.len() == 1
            };
        if components.is_empty() || !sound {
            return Err("a scan's header makes no sense".to_owned());
        }
        self.memory = Memory::default();
        self.units_done = 0;
        Ok(Scan { components, band })
    }

    /// Begins a unit of a scan: at each restart marker everything starts anew.
    fn begin_unit(&mut self) -> Result<(), Reason> {
        let interval = self.restart_interval;
        if interval > 0 && self.units_done > 0 && self.units_done.is_multiple_of(interval) {
            self.bits.restart()?;
            self.memory = Memory::default();
        }
        self.units_done += 1;
        Ok(())
    }

    /// Decodes one block of a scan.
    fn block(
        &mut self,
        part: (usize, usize, usize),
        band: Band,
        block: &mut [i16; 64],
    ) -> Result<(), Reason> {
        let (component, constant, wave) = part;
        let missing = "a Huffman table is missing";
        let constant = self.constants.get(constant).and_then(Option::as_ref);
        let wave = self.waves.get(wave).and_then(Option::as_ref);
        if !self.progressive {
            let (constant, wave) = (constant.ok_or(missing)?, wave.ok_or(missing)?);
            let before = &mut self.memory.constants[component];
            return scan::sequential(&mut self.bits, constant, wave, before, block);
        }
        if band.first == 0 {
            if band.high == 0 && constant.is_none() {
                return Err(missing.to_owned());
            }
            let before = &mut self.memory.constants[component];
            return scan::progressive_constant(&mut self.bits, constant, band, before, block);
        }
        let wave = wave.ok_or(missing)?;
        if band.high == 0 {
            scan::progressive_first(&mut self.bits, wave, band, &mut self.memory, block)
        } else {
            scan::progressive_refine(&mut self.bits, wave, band, &mut self.memory, block)
        }
    }

    /// Reads all scans into the components' coefficients.
    fn load(&mut self) -> Result<(), Reason> {
        for component in &mut self.components {
            component.coefficients = vec![[0; 64]; component.blocks[0] * component.blocks[1]];
        }
        let mut next = Some(self.scan.clone());
        while let Some(scan) = next {
            self.load_scan(&scan)?;
            next = self.read_until_scan(&mut ColourNotes::default())?;
        }
        if self.components.iter().any(|component| component.quantisation.is_none()) {
            return Err("the file ends before all its colours came: it is truncated".to_owned());
        }
        self.loaded = true;
        Ok(())
    }

    fn load_scan(&mut self, scan: &Scan) -> Result<(), Reason> {
        if let &[part] = &scan.components[..] {
            // A scan of one component holds no blocks beyond its edge.
            let component = &self.components[part.0];
            let blocks = [component.width.div_ceil(8), component.height.div_ceil(8)];
            let stride = component.blocks[0];
            for by in 0..blocks[1] {
                for bx in 0..blocks[0] {
                    self.begin_unit()?;
                    self.stored_block(part, scan.band, by * stride + bx)?;
                }
            }
            return Ok(());
        }
        for unit in 0..self.units[0] * self.units[1] {
            self.begin_unit()?;
            let [ux, uy] = [unit % self.units[0], unit / self.units[0]];
            for &part in &scan.components {
                let component = &self.components[part.0];
                let (across, down, stride) =
                    (component.across, component.down, component.blocks[0]);
                for y in uy * down..(uy + 1) * down {
                    for x in ux * across..(ux + 1) * across {
                        self.stored_block(part, scan.band, y * stride + x)?;
                    }
                }
            }
        }
        Ok(())
    }

    fn stored_block(
        &mut self,
        part: (usize, usize, usize),
        band: Band,
        index: usize,
    ) -> Result<(), Reason> {
        let mut block = self.components[part.0].coefficients[index];
        let result = self.block(part, band, &mut block);
        self.components[part.0].coefficients[index] = block;
        result
    }

    /// Makes the samples of the next row of units.
    fn next_units(&mut self) -> Result<(), Reason> {
        let row = self.unit_row;
        if row == self.units[1] {
            return Err("has no more rows".to_owned());
        }
        let next_row = self.next_row;
        for component in &mut self.components {
            // Rows above the last one that is looked at are done with.
            let (near, far, _) = component.rows_of(next_row);
            let keep = near.min(far).clamp(component.first_row, component.rows());
            let done = (keep - component.first_row) * component.stride();
            component.samples.drain(..done);
            component.first_row = keep;
            let room = component.samples.len() + component.stride() * 8 * component.down;
            component.samples.resize(room, 0);
        }
        if self.whole {
            for component in &mut self.components {
                let blocks = component.blocks[0];
                for y in 0..component.down {
                    for x in 0..blocks {
                        let index = (row * component.down + y) * blocks + x;
                        put_block(component, row, x, y, None, index);
                    }
                }
            }
        } else {
            self.stream_units(row)?;
        }
        self.unit_row += 1;
        Ok(())
    }

    /// Reads a row of units of the one scan. A picture of one component has no units but blocks.
    fn stream_units(&mut self, row: usize) -> Result<(), Reason> {
        let scan = self.scan.clone();
        if let [component] = &self.components[..] {
            let (blocks, rows) = (component.width.div_ceil(8), component.height.div_ceil(8));
            let down = component.down;
            for y in 0..down.min(rows.saturating_sub(row * down)) {
                for x in 0..blocks {
                    self.stream_block(scan.components[0], scan.band, row, x, y)?;
                }
            }
            return Ok(());
        }
        for unit in 0..self.units[0] {
            self.begin_unit()?;
            for &part in &scan.components {
                let (across, down) = (self.components[part.0].across, self.components[part.0].down);
                for y in 0..down {
                    for x in unit * across..(unit + 1) * across {
                        let mut block = [0; 64];
                        self.block(part, scan.band, &mut block)?;
                        put_block(&mut self.components[part.0], row, x, y, Some(&block), 0);
                    }
                }
            }
        }
        Ok(())
    }

    fn stream_block(
        &mut self,
        part: (usize, usize, usize),
        band: Band,
        row: usize,
        x: usize,
        y: usize,
    ) -> Result<(), Reason> {
        self.begin_unit()?;
        let mut block = [0; 64];
        self.block(part, band, &mut block)?;
        put_block(&mut self.components[part.0], row, x, y, Some(&block), 0);
        Ok(())
    }
}

/// Transforms a block into the samples of a row of units: `x` in blocks from the left, `y` in blocks
/// within the row.
fn put_block(
    component: &mut Component,
    row: usize,
    x: usize,
    y: usize,
    block: Option<&[i16; 64]>,
    stored: usize,
) {
    let Some(quantisation) = &component.quantisation else { return };
    let block = block.unwrap_or_else(|| &component.coefficients[stored]);
    let samples = transform::samples(block, quantisation);
    let stride = component.stride();
    let top = (row * component.down + y) * 8 - component.first_row;
    for (line, samples) in samples.as_chunks::<8>().0.iter().enumerate() {
        let start = (top + line) * stride + x * 8;
        component.samples[start..start + 8].copy_from_slice(samples);
    }
}

impl RowSource for JpegRows {
    fn next_row(&mut self, out: &mut [u8], _valid: Option<&mut [u8]>) -> Result<(), String> {
        if self.whole && !self.loaded {
            self.load()?;
        }
        let y = self.next_row;
        let lacks = |component: &Component| {
            let (near, far, _) = component.rows_of(y);
            near.max(far) >= component.rows()
        };
        while self.components.iter().any(lacks) {
            self.next_units()?;
        }
        for (component, full) in self.components.iter().zip(&mut self.full) {
            let (near, far, below) = component.rows_of(y);
            component.upsample.row(component.row(near), component.row(far), below, full);
        }
        match &self.full[..] {
            [shades] => {
                for (pixel, shade) in out.chunks_exact_mut(3).zip(shades) {
                    pixel.fill(*shade);
                }
            }
            [a, b, c] => {
                for (pixel, ((a, b), c)) in out.chunks_exact_mut(3).zip(a.iter().zip(b).zip(c)) {
                    let colours =
                        if self.is_rgb { [*a, *b, *c] } else { transform::rgb(*a, *b, *c) };
                    pixel.copy_from_slice(&colours);
                }
            }
            _ => return Err("has no colours".to_owned()),
        }
        self.next_row += 1;
        Ok(())
    }

    fn rewind(&mut self) -> bool {
        if !self.loaded {
            return false;
        }
        for component in &mut self.components {
            component.samples.clear();
            component.first_row = 0;
        }
        (self.unit_row, self.next_row) = (0, 0);
        true
    }
}
