//! The options of `meniscus completions` and `meniscus man`.

use std::path::PathBuf;

use clap::Args;
use clap_complete::Shell;

#[derive(Debug, Args)]
#[command(after_long_help = WHERE_COMPLETIONS_GO)]
pub(in crate::cli) struct CompletionsArgs {
    /// The shell
    #[arg(value_name = "SHELL")]
    pub(in crate::cli) shell: Shell,
}

#[derive(Debug, Args)]
#[command(after_long_help = WHERE_PAGES_GO)]
pub(in crate::cli) struct ManArgs {
    /// Folder for the pages; created if missing
    ///
    /// meniscus.1, meniscus-convert.1 and so on; pages of these names are replaced.
    #[arg(long, value_name = "DIR")]
    pub(in crate::cli) out: PathBuf,
}

const WHERE_COMPLETIONS_GO: &str = "\
Where it goes, for one user:
  bash  meniscus completions bash > ~/.local/share/bash-completion/completions/meniscus
  zsh   meniscus completions zsh > ~/.zfunc/_meniscus
        and in ~/.zshrc, before compinit: fpath+=~/.zfunc
  fish  meniscus completions fish > ~/.config/fish/completions/meniscus.fish
The Debian package has these three in place.";

const WHERE_PAGES_GO: &str = "\
Where they go, for one user:
  meniscus man --out ~/.local/share/man/man1
The Debian package has them in place.";
