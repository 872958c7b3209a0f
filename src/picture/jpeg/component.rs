//! One colour component of a JPEG picture, and what the file says about its colours.

use super::transform::Upsample;

/// One colour component of the picture.
#[derive(Clone, Debug)]
pub(super) struct Component {
    pub(super) id: u8,
    /// Blocks of one unit of the scan, across and down.
    pub(super) across: usize,
    pub(super) down: usize,
    /// Its quantisation table, by number, and taken over when its first scan begins.
    pub(super) table: usize,
    pub(super) quantisation: Option<[u16; 64]>,
    /// Samples that belong to the picture.
    pub(super) width: usize,
    pub(super) height: usize,
    /// Blocks in a row and rows of blocks, with those that fill up the last units.
    pub(super) blocks: [usize; 2],
    pub(super) upsample: Upsample,
    /// The component's rows per row of the picture, inverted.
    pub(super) rows_per_row: usize,
    /// Coefficients of all blocks, where they do not come in the order of the rows.
    pub(super) coefficients: Vec<[i16; 64]>,
    /// Samples of the rows from `first_row` on.
    pub(super) samples: Vec<u8>,
    pub(super) first_row: usize,
}

impl Component {
    pub(super) fn stride(&self) -> usize {
        self.blocks[0] * 8
    }

    pub(super) fn rows(&self) -> usize {
        self.first_row + self.samples.len() / self.stride()
    }

    pub(super) fn row(&self, row: usize) -> &[u8] {
        &self.samples[(row - self.first_row) * self.stride()..][..self.width]
    }

    /// The row that a picture's row lies in, the nearer of its neighbours, and whether that is below.
    pub(super) fn rows_of(&self, y: usize) -> (usize, usize, bool) {
        let near = y / self.rows_per_row;
        let below = !y.is_multiple_of(self.rows_per_row);
        if !self.upsample.looks_around() {
            return (near, near, below);
        }
        let far = if below { (near + 1).min(self.height - 1) } else { near.saturating_sub(1) };
        (near, far, below)
    }
}

/// What the file says about its colours.
#[derive(Debug, Default)]
pub(super) struct ColourNotes {
    jfif: bool,
    /// The transform that Adobe's segment states.
    adobe: Option<u8>,
}

impl ColourNotes {
    pub(super) fn segment(&mut self, marker: u8, data: &[u8]) {
        if marker == 0xE0 && data.starts_with(b"JFIF\0") {
            self.jfif = true;
        }
        if marker == 0xEE && data.starts_with(b"Adobe") {
            self.adobe = data.get(11).copied();
        }
    }

    /// Whether three components are RGB and not luminance and two colour differences.
    pub(super) fn is_rgb(&self, components: &[Component]) -> bool {
        match (self.jfif, self.adobe) {
            (true, _) => false,
            (false, Some(transform)) => transform == 0,
            (false, None) => components.iter().map(|c| c.id).eq(*b"RGB"),
        }
    }
}
