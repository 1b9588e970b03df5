//! HTML page with style and script, and escaping.

use std::fmt::Write as _;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use sha2::{Digest, Sha256};

const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");

/// A page in the making.
#[derive(Default)]
pub struct Page {
    body: String,
    headings: Vec<String>,
    sources: Vec<String>,
}

/// Escapes text for HTML.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c => out.push(c),
        }
    }
    out
}

/// Percent-encodes a byte of a relative URL, colons included.
fn address_byte(byte: u8) -> String {
    match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'.' | b'-' | b'_' => char::from(byte).to_string(),
        other => format!("%{other:02X}"),
    }
}

impl Page {
    /// A section's heading, linked from the top.
    pub fn heading(&mut self, text: &str) {
        let _ = writeln!(self.body, "<h2 id=\"s{}\">{}</h2>", self.headings.len(), escape(text));
        self.headings.push(text.to_owned());
    }

    /// Adds to what the page says in its head that it was made of.
    pub fn source(&mut self, identity: &str) {
        self.sources.push(identity.to_owned());
    }

    /// A smaller heading.
    pub fn subheading(&mut self, text: &str) {
        let _ = writeln!(self.body, "<h3>{}</h3>", escape(text));
    }

    /// A paragraph of text.
    pub fn paragraph(&mut self, text: &str) {
        let _ = writeln!(self.body, "<p>{}</p>", escape(text));
    }

    /// Cells of text; the first row is the head, columns that hold numbers only are aligned right.
    pub fn table(&mut self, rows: &[Vec<String>]) {
        let Some((head, rows)) = rows.split_first() else { return };
        let numeric =
            |cell: &str| cell.starts_with(|c: char| c.is_ascii_digit() || "-–+".contains(c)) || cell.is_empty();
        let right = |column: usize| rows.iter().all(|row| row.get(column).is_none_or(|c| numeric(c)));
        let class = |column: usize| if right(column) { " class=n" } else { "" };
        self.body.push_str("<div class=wide><table><tr>");
        for (i, cell) in head.iter().enumerate() {
            let _ = write!(self.body, "<th{}>{}</th>", class(i), escape(cell));
        }
        for row in rows {
            self.body.push_str("</tr>\n<tr>");
            for (i, cell) in row.iter().enumerate() {
                let _ = write!(self.body, "<td{}>{}</td>", class(i), strong(&escape(cell)));
            }
        }
        self.body.push_str("</tr></table></div>\n");
    }

    /// A link to a relative path.
    pub fn link(&mut self, path: &str, text: &str) {
        let address: String = path.bytes().map(address_byte).collect();
        let _ = writeln!(self.body, "<p><a href=\"{address}\">{}</a></p>", escape(text));
    }

    /// Preformatted text in a collapsed section.
    pub fn folded(&mut self, title: &str, text: &str) {
        let (title, text) = (escape(title), escape(text));
        let _ = writeln!(self.body, "<details><summary>{title}</summary><pre>{text}</pre></details>");
    }

    /// A picture with its caption; `kind` is its media type.
    pub fn picture(&mut self, kind: &str, bytes: &[u8], caption: &str) {
        let (caption, data) = (escape(caption), STANDARD.encode(bytes));
        let _ = writeln!(
            self.body,
            "<figure><div class=wide><img alt=\"{caption}\" src=\"data:{kind};base64,{data}\"></div><figcaption>{caption}</figcaption></figure>"
        );
    }

    /// Trusted markup.
    pub fn raw(&mut self, markup: &str) {
        self.body.push_str(markup);
    }

    /// The whole file.
    pub fn finish(&self, title: &str) -> String {
        let (title, sources) = (escape(title), escape(&self.sources.join("; ")));
        let links: Vec<String> = (self.headings.iter().enumerate())
            .map(|(i, text)| format!("<a href=\"#s{i}\">{}</a>", escape(text)))
            .collect();
        let links = if links.len() > 2 { format!("<nav>{}</nav>\n", links.join(" ")) } else { String::new() };
        // Defence in depth behind the escaping: no other script, no network.
        let script = STANDARD.encode(Sha256::digest(SCRIPT));
        let policy = format!(
            "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{script}'; \
             base-uri 'none'; form-action 'none'"
        );
        format!(
            "<!doctype html>\n<html lang=en>\n<meta charset=\"utf-8\">\n\
             <meta http-equiv=\"Content-Security-Policy\" content=\"{policy}\">\n\
             <meta name=\"source\" content=\"{sources}\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <title>{title}</title>\n<style>{STYLE}</style>\n<h1>{title}</h1>\n{links}{}<script>{SCRIPT}</script>\n</html>\n",
            self.body
        )
    }
}

/// **This** of escaped text as bold.
fn strong(text: &str) -> String {
    let parts: Vec<&str> = text.split("**").collect();
    if parts.len().is_multiple_of(2) {
        return text.to_owned();
    }
    let wrap = |(i, part): (usize, &&str)| if i % 2 == 1 { format!("<b>{part}</b>") } else { (*part).to_owned() };
    parts.iter().enumerate().map(wrap).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_leads_to_a_file_whatever_its_name() {
        let mut page = Page::default();
        page.link("javascript:a b\"/é.html", "<x>");
        let page = page.finish("title");
        assert!(page.contains("<a href=\"javascript%3Aa%20b%22/%C3%A9.html\">&lt;x&gt;</a>"), "{page}");
    }
}
