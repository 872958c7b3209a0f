//! `--shard i/n`: a part of a batch for one of several machines.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// Part `index` (from 1) of `count`. Items are dealt in contiguous runs of the scheduled order, so
/// that neighbours share blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Shard {
    /// 1-based index.
    pub index: u32,
    /// Number of shards.
    pub count: u32,
}

impl Shard {
    /// The whole batch.
    pub const WHOLE: Self = Self { index: 1, count: 1 };

    /// Range of item positions (out of `len`) that belong to this shard.
    #[must_use]
    pub fn range(self, len: usize) -> std::ops::Range<usize> {
        let cut = |k: u32| (len as u128 * u128::from(k) / u128::from(self.count)) as usize;
        cut(self.index - 1)..cut(self.index)
    }

    /// Whether this is the whole batch.
    #[must_use]
    pub const fn is_whole(self) -> bool {
        self.count == 1
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        text.split_once('/')
            .and_then(|(i, n)| Some(Self { index: i.parse().ok()?, count: n.parse().ok()? }))
            .filter(|s| s.index >= 1 && s.index <= s.count)
            .ok_or_else(|| {
                format!("`{text}` is no shard; write i/n with 1 <= i <= n, for example 2/8")
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_cover_every_item_once() {
        for len in [0, 1, 7, 100] {
            for count in 1..9 {
                let mut next = 0;
                for index in 1..=count {
                    let range = Shard { index, count }.range(len);
                    assert_eq!(range.start, next);
                    next = range.end;
                }
                assert_eq!(next, len);
            }
        }
    }

    #[test]
    fn text_forms() {
        assert_eq!("2/8".parse(), Ok(Shard { index: 2, count: 8 }));
        for bad in ["", "2", "0/3", "4/3", "a/b", "1/0", "1/-2"] {
            assert!(bad.parse::<Shard>().is_err(), "{bad}");
        }
    }
}
