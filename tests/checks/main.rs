//! What is written about the program, and what it is built of: that pages, the README and the manifests are true.
//!
//! Plain `cargo test` leaves these out (`test = false` in Cargo.toml); `cargo test --test checks` and `.ci/run` run them.

mod dependencies; // a reason for each crate, and nothing in C
mod docs; // links of the pages lead somewhere, and what they say is tested is
mod formats; // the table of what is read, written and kept
mod options; // the help, the example of a configuration and the page of options know the same options
mod readme; // every command in the README and the tutorials, run as it stands there
mod report; // the page of the report has each of its fields
#[path = "../meniscus/scene.rs"]
#[expect(dead_code, reason = "some of it is for other tests")]
mod scene; // small frames of particles, and a way to run the command
mod troubleshooting; // the page of symptoms quotes the program
