//! Access control: the host name of a request, and the token.
//!
//! A page on any web site can make a browser send requests to this machine, and can even let its own domain
//! name resolve to this address (DNS rebinding). But the browser then sends that domain name in the `Host`
//! header. So the header must contain an address, or `localhost`. A server that listens on more than the
//! loopback address also requires a token.

use std::fmt;
use std::hint::black_box;
use std::net::IpAddr;

use axum::extract::Request;
use axum::http::HeaderMap;
use axum::http::header::{AUTHORIZATION, COOKIE, HOST};
use axum::http::uri::Authority;

/// The secret that clients must send. Its `Debug` output does not contain it.
#[derive(Clone, PartialEq, Eq)]
pub struct AccessToken(String);

impl AccessToken {
    /// Creates a token from 16 to 256 ASCII letters, digits, and `-`, `_`, `.`, `~`; `None` if the text has
    /// another length or other characters.
    pub fn new(text: &str) -> Option<AccessToken> {
        let is_right = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.~".contains(&byte);
        let is_valid = (16..=256).contains(&text.len()) && text.bytes().all(is_right);
        is_valid.then(|| AccessToken(text.to_owned()))
    }

    /// Compares in constant time, so that timing does not reveal how much of a guess is right.
    pub(super) fn is(&self, given: &str) -> bool {
        let pairs = self.0.bytes().zip(given.bytes());
        let difference = pairs.fold(self.0.len() ^ given.len(), |all, (a, b)| all | usize::from(a ^ b));
        black_box(difference) == 0
    }

    /// Whether a request to the server at this port carries the token: as `Authorization: Bearer`, or in the
    /// cookie.
    pub(super) fn is_in(&self, headers: &HeaderMap, port: u16) -> bool {
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

/// Whether a request names this machine by an address or as `localhost`, with or without a port. Any port and
/// any address are accepted: a tunnel has others than this machine, and no web site can choose them.
pub(super) fn is_for_this_machine(request: &Request) -> bool {
    let mut hosts = request.headers().get_all(HOST).iter();
    let (Some(host), None) = (hosts.next(), hosts.next()) else { return false };
    let host = host.to_str().ok().and_then(|host| host.parse().ok());
    host.is_some_and(|host| is_no_domain(&host)) && request.uri().authority().is_none_or(is_no_domain)
}

fn is_no_domain(authority: &Authority) -> bool {
    let host = authority.host();
    let address = host.trim_start_matches('[').trim_end_matches(']');
    host.eq_ignore_ascii_case("localhost") || address.parse::<IpAddr>().is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::body::Body;

    #[test]
    fn only_addresses_and_localhost_are_accepted_as_host() {
        let is_accepted = |uri: &str, hosts: &[&str]| {
            let request = hosts.iter().fold(Request::get(uri), |request, host| request.header(HOST, *host));
            is_for_this_machine(&request.body(Body::empty()).expect("a request"))
        };
        for host in ["localhost", "LOCALHOST:7700", "127.0.0.1:1", "[::1]:7700", "192.168.1.7:7700"] {
            assert!(is_accepted("/", &[host]), "{host}");
        }
        for host in
            ["evil.example", "localhost.evil.example", "127.0.0.1.nip.io", "localhost@evil.example", ""]
        {
            assert!(!is_accepted("/", &[host]), "{host}");
        }
        assert!(!is_accepted("/", &[]));
        assert!(!is_accepted("/", &["localhost", "localhost"]));
        assert!(!is_accepted("http://evil.example/", &["localhost"]));
    }

    #[test]
    fn only_the_whole_token_is_accepted() {
        let token = AccessToken::new("0123456789abcdef").expect("a token");
        assert!(token.is("0123456789abcdef"));
        for wrong in ["", "0123456789abcde", "0123456789abcdeg", "0123456789abcdef0"] {
            assert!(!token.is(wrong), "{wrong}");
        }
        for text in ["short", "0123456789abcde;", "0123456789abcde f", &"x".repeat(257)] {
            assert_eq!(AccessToken::new(text), None, "{text}");
        }
        assert_eq!(format!("{token:?}"), "AccessToken");
    }

    #[test]
    fn token_is_read_from_the_bearer_header_and_the_cookie() {
        let token = AccessToken::new("0123456789abcdef").expect("a token");
        let is_in = |name, value: &'static str| {
            let value = value.parse().expect("a value");
            token.is_in(&HeaderMap::from_iter([(name, value)]), 7700)
        };
        assert!(is_in(AUTHORIZATION, "Bearer 0123456789abcdef"));
        assert!(is_in(COOKIE, "a=b; meniscus_token_7700=0123456789abcdef"));
        assert!(is_in(COOKIE, "meniscus_token_7701=x; meniscus_token_7700=0123456789abcdef"));
        assert!(!is_in(AUTHORIZATION, "0123456789abcdef"));
        assert!(!is_in(COOKIE, "xmeniscus_token_7700=0123456789abcdef"));
        assert!(!is_in(COOKIE, "meniscus_token_7701=0123456789abcdef"), "that is for another port");
        assert!(!token.is_in(&HeaderMap::new(), 7700));
        assert!(token.cookie(7700).starts_with("meniscus_token_7700=0123456789abcdef; "));
    }
}
