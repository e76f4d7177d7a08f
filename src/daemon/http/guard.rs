//! Checks requests: the host must be this machine, a page the viewer's own, and the token the right
//! one, if one is required.

use super::token::Token;
use hyper::Uri;
use hyper::header::{self, HeaderMap, HeaderName, HeaderValue};
use std::net::IpAddr;

/// The header that every change must have.
const GUARD: HeaderName = HeaderName::from_static("x-coseg");
/// The header in which a browser describes the page that sends a request.
const FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");
/// The cookie that a browser sends in place of the token that opened the viewer.
const COOKIE: &str = "coseg_token";

/// The checks of one endpoint.
pub(super) struct Guard {
    /// Only the names of this machine's loopback are allowed as hosts.
    pub(super) local: bool,
    /// The token that requests must have, if any.
    pub(super) token: Option<Token>,
    /// Whether monitoring needs no token.
    pub(super) open_monitoring: bool,
}

impl Guard {
    /// Refuses hosts that are not this machine's, although their names lead to it.
    pub(super) fn check_host(&self, uri: &Uri, headers: &HeaderMap) -> Result<(), String> {
        let mut hosts = headers.get_all(header::HOST).iter();
        let (host, another) = (hosts.next(), hosts.next());
        if another.is_some() {
            return Err("a request has one host".to_owned());
        }
        if !self.local {
            return Ok(());
        }
        let host = host.map_or("", |h| h.to_str().unwrap_or("?"));
        // The host of the target overrides the header.
        let target = uri.authority().map(|a| a.as_str());
        for host in [Some(host), target].into_iter().flatten() {
            if !is_loopback(host) {
                return Err(format!("the host {host:?} is not this machine's loopback"));
            }
        }
        Ok(())
    }

    /// Whether the request has the token, or none is required.
    pub(super) fn knows(&self, headers: &HeaderMap) -> bool {
        let Some(token) = &self.token else {
            return true;
        };
        let bearer = headers.get_all(header::AUTHORIZATION).iter();
        let bearer = bearer.filter_map(|v| {
            let (scheme, shown) = v.to_str().ok()?.split_once(' ')?;
            scheme.eq_ignore_ascii_case("bearer").then_some(shown)
        });
        let cookies = headers.get_all(header::COOKIE).iter();
        let cookies = cookies
            .filter_map(|v| v.to_str().ok())
            .flat_map(|v| v.split(';'))
            .filter_map(|pair| pair.trim().strip_prefix(COOKIE)?.strip_prefix('='));
        bearer.chain(cookies).any(|shown| token.is(shown.trim()))
    }

    /// The cookie that replaces the token from now on, if it is the right one.
    pub(super) fn cookie(&self, shown: &str) -> Option<HeaderValue> {
        self.token.as_ref().filter(|token| token.is(shown))?;
        let cookie = format!("{COOKIE}={shown}; Path=/; HttpOnly; SameSite=Strict");
        HeaderValue::try_from(cookie).ok()
    }
}

/// Refuses requests that a page of another site makes a browser send: that page could read nothing,
/// but make the daemon compute much.
pub(super) fn check_site(headers: &HeaderMap) -> Result<(), String> {
    let own = ["same-origin", "none"];
    match headers.get(FETCH_SITE).map(HeaderValue::to_str) {
        Some(site) if !site.as_ref().is_ok_and(|s| own.contains(s)) => {
            Err("only the viewer's own page may ask".to_owned())
        }
        _ => Ok(()),
    }
}

/// Refuses a change that the viewer's own page does not ask for.
pub(super) fn check_change(headers: &HeaderMap) -> Result<(), String> {
    let mut guards = headers.get_all(GUARD).iter().peekable();
    if guards.peek().is_none() || !guards.all(|g| g == "1") {
        return Err(format!("a change needs the header {GUARD}: 1"));
    }
    // A browser sends where the page came from; other programs need not.
    let host = headers.get(header::HOST).and_then(|h| h.to_str().ok());
    let own = |origin: &HeaderValue| {
        let (scheme, of) = origin.to_str().ok()?.split_once("://")?;
        Some(["http", "https"].contains(&scheme) && Some(of) == host)
    };
    if headers
        .get_all(header::ORIGIN)
        .iter()
        .all(|o| own(o) == Some(true))
    {
        return Ok(());
    }
    Err("a change must come from the viewer's own page".to_owned())
}

/// Whether the host of a request, with or without a port, is a loopback address or `localhost`.
fn is_loopback(host: &str) -> bool {
    let (name, port) = match host.strip_prefix('[') {
        Some(v6) => match v6.split_once(']') {
            Some((name, rest)) => (name, rest),
            None => return false,
        },
        None => host.split_at(host.find(':').unwrap_or(host.len())),
    };
    let is_port = |p: &str| p.len() <= 5 && p.chars().all(|c| c.is_ascii_digit());
    let is_v6 = host.starts_with('[');
    let is_local = |ip: IpAddr| ip.is_loopback() && ip.is_ipv6() == is_v6;
    (port.is_empty() || port.strip_prefix(':').is_some_and(is_port))
        && (!is_v6 && name.eq_ignore_ascii_case("localhost")
            || name.parse::<IpAddr>().is_ok_and(is_local))
}

#[cfg(test)]
mod tests {
    use super::{Guard, check_change, check_site, is_loopback};
    use crate::daemon::http::token::Token;
    use hyper::header::{HeaderMap, HeaderName, HeaderValue};

    fn headers(pairs: &[(&'static str, &'static str)]) -> HeaderMap {
        let pair = |&(name, value)| {
            (
                HeaderName::from_static(name),
                HeaderValue::from_static(value),
            )
        };
        let mut headers = HeaderMap::new();
        for (name, value) in pairs.iter().map(pair) {
            headers.append(name, value);
        }
        headers
    }

    #[test]
    fn only_names_of_loopback_are_this_machine() {
        for host in [
            "localhost",
            "LocalHost:80",
            "127.0.0.1:8640",
            "127.1.2.3",
            "[::1]:80",
            "[::1]",
        ] {
            assert!(is_loopback(host), "{host}");
        }
        for host in [
            "",
            "example.org",
            "localhost.example.org",
            "10.0.0.1:80",
            "[::2]",
            "127.0.0.1.x",
            "[::1].evil.example",
            "[::1]evil",
            "[::1",
            "[localhost]",
            "[127.0.0.1]",
            "::1",
            "localhost:evil",
            "localhost:80:80",
            "127.0.0.1:80@evil.example",
            "localhost.",
            "0.0.0.0",
        ] {
            assert!(!is_loopback(host), "{host}");
        }
    }

    fn guard() -> Guard {
        let path = tempfile::tempdir().unwrap();
        let file = path.path().join("token");
        std::fs::write(&file, "0123456789abcdef").unwrap();
        std::fs::set_permissions(&file, std::os::unix::fs::PermissionsExt::from_mode(0o600))
            .unwrap();
        Guard {
            local: true,
            token: Token::read_or_make(&file).ok(),
            open_monitoring: false,
        }
    }

    #[test]
    fn every_host_that_a_request_names_is_looked_at() {
        let check = |uri: &str, pairs: &[(&'static str, &'static str)]| {
            guard().check_host(&uri.parse().unwrap(), &headers(pairs))
        };
        assert!(check("/", &[("host", "localhost")]).is_ok());
        assert!(check("http://localhost/", &[("host", "localhost")]).is_ok());
        for (uri, pairs) in [
            ("/", &[] as &[_]),
            ("/", &[("host", "evil.example")]),
            ("/", &[("host", "localhost"), ("host", "evil.example")]),
            ("http://evil.example/", &[("host", "localhost")]),
            ("http://localhost/", &[("host", "evil.example")]),
        ] {
            assert!(check(uri, pairs).is_err(), "{uri} {pairs:?}");
        }
    }

    #[test]
    fn a_token_is_shown_as_bearer_or_cookie() {
        let guard = guard();
        for pair in [
            ("authorization", "Bearer 0123456789abcdef"),
            ("authorization", "bearer 0123456789abcdef"),
            ("cookie", "a=b; coseg_token=0123456789abcdef"),
        ] {
            assert!(guard.knows(&headers(&[pair])), "{pair:?}");
        }
        for pair in [
            ("authorization", "Basic 0123456789abcdef"),
            ("authorization", "Bearer 0123456789abcdeg"),
            ("authorization", "Bearer "),
            ("cookie", "coseg_token=; xcoseg_token=0123456789abcdef"),
            ("x-coseg", "0123456789abcdef"),
        ] {
            assert!(!guard.knows(&headers(&[pair])), "{pair:?}");
        }
        assert!(guard.cookie("0123456789abcdeg").is_none());
        let cookie = guard.cookie("0123456789abcdef").unwrap();
        let cookie = cookie.to_str().unwrap();
        assert!(cookie.contains("; HttpOnly; SameSite=Strict"), "{cookie}");
    }

    #[test]
    fn changes_come_from_the_page_itself() {
        let host = ("host", "localhost:80");
        let guard = ("x-coseg", "1");
        for pairs in [
            vec![host, guard],
            vec![host, guard, ("origin", "http://localhost:80")],
            vec![host, guard, ("origin", "https://localhost:80")],
        ] {
            assert_eq!(check_change(&headers(&pairs)), Ok(()), "{pairs:?}");
        }
        for pairs in [
            vec![host],
            vec![host, ("x-coseg", "0")],
            vec![host, ("x-coseg", "0"), guard],
            vec![host, guard, ("origin", "null")],
            vec![host, guard, ("origin", "")],
            vec![host, guard, ("origin", "//localhost:80")],
            vec![host, guard, ("origin", "http://localhost:81")],
            vec![host, guard, ("origin", "http://evil.example")],
            vec![
                host,
                guard,
                ("origin", "http://localhost:80"),
                ("origin", "http://evil.example"),
            ],
        ] {
            assert!(check_change(&headers(&pairs)).is_err(), "{pairs:?}");
        }
        assert!(check_site(&headers(&[])).is_ok());
        assert!(check_site(&headers(&[("sec-fetch-site", "same-origin")])).is_ok());
        assert!(check_site(&headers(&[("sec-fetch-site", "cross-site")])).is_err());
        assert!(check_site(&headers(&[("sec-fetch-site", "same-site")])).is_err());
    }
}
