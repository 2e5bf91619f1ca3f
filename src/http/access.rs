//! Access control: the host name of a request, and the token.
//!
//! A page on any web site can make a browser send requests to this machine, and can even let its own domain
//! name resolve to this address (DNS rebinding). But the browser then sends that domain name in the `Host`
//! header. So the header must contain a name of this machine. A server that listens on more than the loopback
//! address also requires a token.

use std::fmt;
use std::hint::black_box;
use std::net::IpAddr;

use hyper::header::{AUTHORIZATION, COOKIE, HOST};
use hyper::{Request, Uri};

/// The secret that clients must send. Its `Debug` output does not contain it.
#[derive(Clone, PartialEq, Eq)]
pub struct AccessToken(String);

/// A text is not a valid token.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TokenError;

impl AccessToken {
    /// Creates a token from 16 to 256 ASCII letters, digits, and `-`, `_`, `.`, `~`.
    ///
    /// # Errors
    /// When the text has another length or other characters.
    pub fn new(text: &str) -> Result<AccessToken, TokenError> {
        let is_right = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.~".contains(&byte);
        match (16..=256).contains(&text.len()) && text.bytes().all(is_right) {
            true => Ok(AccessToken(text.to_owned())),
            false => Err(TokenError),
        }
    }

    /// Compares in constant time, so that timing does not reveal how much of a guess is right.
    pub(super) fn is(&self, given: &str) -> bool {
        let (wanted, given) = (self.0.as_bytes(), given.as_bytes());
        let mut difference = u8::from(wanted.len() != given.len());
        for (index, byte) in wanted.iter().enumerate() {
            difference |= byte ^ given.get(index).copied().unwrap_or(0);
        }
        black_box(difference) == 0
    }

    /// Whether a request carries the token for the server at this port: as `Authorization: Bearer`, or in the
    /// cookie.
    pub(super) fn is_in<B>(&self, request: &Request<B>, port: u16) -> bool {
        let headers = request.headers();
        let bearer =
            headers.get(AUTHORIZATION).and_then(|value| value.to_str().ok()?.strip_prefix("Bearer "));
        let cookies = headers.get_all(COOKIE).iter().filter_map(|value| value.to_str().ok());
        let name = cookie_name(port);
        let mut given = cookies
            .flat_map(|cookies| cookies.split(';'))
            .filter_map(|cookie| cookie.trim().strip_prefix(&name)?.strip_prefix('='));
        bearer.is_some_and(|bearer| self.is(bearer)) || given.any(|given| self.is(given))
    }

    /// The cookie that makes a browser send the token to the server at this port.
    pub(super) fn cookie(&self, port: u16) -> String {
        format!("{}={}; Path=/; HttpOnly; SameSite=Strict", cookie_name(port), self.0)
    }
}

/// Browsers share cookies between all ports of a host: without the port in the name, two daemons would
/// overwrite each other's cookie.
fn cookie_name(port: u16) -> String {
    format!("meniscus_token_{port}")
}

impl fmt::Debug for AccessToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("AccessToken")
    }
}

impl fmt::Display for TokenError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a token has 16 to 256 characters: ASCII letters, digits, and - _ . ~")
    }
}

impl std::error::Error for TokenError {}

/// Whether the host in a request that came in at the address `local` is this machine.
pub(super) fn is_for_this_host<B>(request: &Request<B>, local: IpAddr) -> bool {
    let mut hosts = request.headers().get_all(HOST).iter();
    let (Some(host), None) = (hosts.next(), hosts.next()) else { return false };
    let is_ours = |authority: &str| is_name_of(authority, local);
    let in_uri = request.uri().authority().is_none_or(|authority| is_ours(authority.as_str()));
    in_uri && host.to_str().is_ok_and(is_ours)
}

/// Whether this is a name of this machine, with or without a port: `localhost`, a loopback address, or the
/// local address. Any port is accepted: a client that connects through a tunnel sends the tunnel's port, and
/// this does no harm.
fn is_name_of(authority: &str, local: IpAddr) -> bool {
    let Ok(uri) = authority.parse::<Uri>() else { return false };
    let (Some(host), Some(parsed)) = (uri.host(), uri.authority()) else { return false };
    if parsed.as_str().contains('@') {
        return false;
    }
    if host.eq_ignore_ascii_case("localhost") {
        return true;
    }
    let bare = host.trim_start_matches('[').trim_end_matches(']');
    let Ok(address) = bare.parse::<IpAddr>() else { return false };
    address.is_loopback() || address.to_canonical() == local.to_canonical()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request_to(host: &str) -> Request<()> {
        Request::get("/").header(HOST, host).body(()).expect("a request")
    }

    #[test]
    fn only_names_of_this_machine_are_accepted_as_host() {
        let local: IpAddr = "192.168.1.7".parse().expect("an address");
        for host in ["localhost", "LOCALHOST:7700", "127.0.0.1:1", "[::1]:7700", "192.168.1.7:7700"] {
            assert!(is_for_this_host(&request_to(host), local), "{host}");
        }
        for host in
            ["evil.example", "localhost.evil.example", "192.168.1.8", "a@localhost", "", "127.0.0.1.nip.io"]
        {
            assert!(!is_for_this_host(&request_to(host), local), "{host}");
        }
        let none = Request::get("/").body(()).expect("a request");
        let two =
            Request::get("/").header(HOST, "localhost").header(HOST, "localhost").body(()).expect("one");
        let other =
            Request::get("http://evil.example/").header(HOST, "localhost").body(()).expect("a request");
        for request in [none, two, other] {
            assert!(!is_for_this_host(&request, local), "{request:?}");
        }
    }

    #[test]
    fn only_the_whole_token_is_accepted() {
        let token = AccessToken::new("0123456789abcdef").expect("a token");
        assert!(token.is("0123456789abcdef"));
        for wrong in ["", "0123456789abcde", "0123456789abcdeg", "0123456789abcdef0"] {
            assert!(!token.is(wrong), "{wrong}");
        }
        for text in ["short", "0123456789abcde;", "0123456789abcde f", &"x".repeat(257)] {
            assert_eq!(AccessToken::new(text), Err(TokenError), "{text}");
        }
        assert_eq!(format!("{token:?}"), "AccessToken");
    }

    #[test]
    fn token_is_read_from_the_bearer_header_and_the_cookie() {
        let token = AccessToken::new("0123456789abcdef").expect("a token");
        let with =
            |name: &str, value: &str| Request::get("/").header(name, value).body(()).expect("a request");
        let is_in = |name: &str, value: &str| token.is_in(&with(name, value), 7700);
        assert!(is_in("authorization", "Bearer 0123456789abcdef"));
        assert!(is_in("cookie", "a=b; meniscus_token_7700=0123456789abcdef"));
        assert!(is_in("cookie", "meniscus_token_7701=x; meniscus_token_7700=0123456789abcdef"));
        assert!(!is_in("authorization", "0123456789abcdef"));
        assert!(!is_in("cookie", "xmeniscus_token_7700=0123456789abcdef"));
        assert!(!is_in("cookie", "meniscus_token_7701=0123456789abcdef"), "that is for another port");
        assert!(!token.is_in(&request_to("localhost"), 7700));
        assert!(token.cookie(7700).starts_with("meniscus_token_7700=0123456789abcdef; "));
    }
}
