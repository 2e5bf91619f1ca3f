//! Checks that the documentation, the README and the manifests agree with the program.

mod commands; // every command in the README and the tutorials runs as written
mod dependencies; // each crate has a reason, and no crate has C code
mod docs; // every link has a target, and every test named in a page exists
mod floors; // families of formats import only the ground floor
mod formats; // the table of formats is complete
mod options; // the help, the example configuration and the page of options have the same options
mod report; // the page of the report has every field
mod troubleshooting; // the messages on the troubleshooting page exist in the program
