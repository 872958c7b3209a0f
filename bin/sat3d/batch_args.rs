//! Arguments that every batch takes.

use clap::ValueEnum;
use sat3d::batch::{Shard, Verify};

/// How a batch is run: in how many threads, which part, over what is there.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct BatchArgs {
    /// Threads (default: all cores); the output does not depend on it
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Do part i of n; `merge` joins the parts
    #[arg(long, value_name = "i/n", default_value = "1/1")]
    pub(crate) shard: Shard,
    /// How results of earlier runs are checked: sizes and times, or hashes
    #[arg(long, value_enum, default_value_t = VerifyArg::Quick)]
    verify: VerifyArg,
    /// Replace results that were made with other options
    #[arg(long)]
    pub(crate) overwrite: bool,
    /// Print the plan (each step, its error bound, cost and cause) and stop
    #[arg(long)]
    pub(crate) explain: bool,
    /// Print the summary as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum VerifyArg {
    Quick,
    Hashes,
}

impl BatchArgs {
    /// Threads, all cores where none are said.
    pub(crate) fn threads(&self) -> usize {
        let all = || std::thread::available_parallelism().map_or(1, usize::from);
        self.threads.unwrap_or_else(all).max(1)
    }

    /// How earlier results are checked.
    pub(crate) const fn verify(&self) -> Verify {
        match self.verify {
            VerifyArg::Quick => Verify::Quick,
            VerifyArg::Hashes => Verify::Hashes,
        }
    }
}

/// `--gsd`: metres per pixel, one number or two.
pub(crate) fn parse_gsd(text: &str) -> Result<[f64; 2], String> {
    let number = |part: &str| {
        let value = part.trim().parse::<f64>().ok().filter(|gsd| gsd.is_finite() && *gsd > 0.0);
        value.ok_or_else(|| {
            format!("`{text}` is not metres per pixel: one positive number, or two (across,down)")
        })
    };
    match text.split_once(',') {
        Some((across, down)) => Ok([number(across)?, number(down)?]),
        None => number(text).map(|gsd| [gsd, gsd]),
    }
}
