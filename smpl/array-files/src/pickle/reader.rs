//! Cursor over the bytes of a pickle.

/// Result of a step of the machine; file and offset are added to the message by the caller.
pub(super) type Step<T> = Result<T, String>;

pub(super) struct Reader<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) at: usize,
}

impl<'a> Reader<'a> {
    pub(super) fn take(&mut self, length: u64) -> Step<&'a [u8]> {
        let rest = &self.bytes[self.at..];
        let length = usize::try_from(length).ok().filter(|&n| n <= rest.len()).ok_or("truncated")?;
        self.at += length;
        Ok(&rest[..length])
    }

    /// Little-endian unsigned integer of `size` ≤ 8 bytes.
    pub(super) fn uint(&mut self, size: u64) -> Step<u64> {
        Ok(self.take(size)?.iter().rev().fold(0, |n, &byte| n << 8 | u64::from(byte)))
    }

    /// Bytes preceded by their length in `size` bytes.
    pub(super) fn counted(&mut self, size: u64) -> Step<&'a [u8]> {
        let length = self.uint(size)?;
        self.take(length)
    }

    /// The rest of the line, without its end.
    pub(super) fn line_bytes(&mut self) -> Step<&'a [u8]> {
        let rest = &self.bytes[self.at..];
        let end = rest.iter().position(|&b| b == b'\n').ok_or("truncated")?;
        self.at += end + 1;
        Ok(&rest[..end])
    }

    /// The rest of the line as text.
    pub(super) fn line(&mut self) -> Step<&'a str> {
        let line = std::str::from_utf8(self.line_bytes()?).map_err(|_| "line is not UTF-8")?;
        Ok(line.trim_end_matches('\r'))
    }

    /// The rest of the line as a number.
    pub(super) fn number<T: std::str::FromStr>(&mut self) -> Step<T> {
        number(self.line()?)
    }
}

pub(super) fn number<T: std::str::FromStr>(text: &str) -> Step<T> {
    text.trim().parse().map_err(|_| format!("number {text:?}"))
}

/// Two's complement of any length, little-endian, as opcode LONG1 stores it.
pub(super) fn long(bytes: &[u8]) -> Step<i64> {
    let fill = if bytes.last().is_some_and(|b| b & 0x80 != 0) { 0xff } else { 0 };
    let mut word = [fill; 8];
    let (low, high) = bytes.split_at(bytes.len().min(8));
    word[..low.len()].copy_from_slice(low);
    let value = i64::from_le_bytes(word);
    if high.iter().any(|&b| b != fill) || (value < 0) != (fill == 0xff) {
        return Err("integer beyond 64 bits".to_owned());
    }
    Ok(value)
}

/// Decodes a quoted Python 2 string literal.
pub(super) fn unquote(line: &str) -> Step<Vec<u8>> {
    let inner = ['\'', '"'].iter().find_map(|&quote| line.strip_prefix(quote)?.strip_suffix(quote));
    let mut bytes = inner.ok_or("string without quotes")?.bytes();
    let mut out = Vec::with_capacity(bytes.len());
    while let Some(b) = bytes.next() {
        if b != b'\\' {
            out.push(b);
            continue;
        }
        out.push(match bytes.next() {
            Some(b'n') => b'\n',
            Some(b't') => b'\t',
            Some(b'r') => b'\r',
            Some(b'x') => {
                let mut digit = || bytes.next().and_then(|b| char::from(b).to_digit(16)).ok_or("escape in string");
                (16 * digit()? + digit()?) as u8
            }
            Some(b @ (b'\\' | b'\'' | b'"')) => b,
            _ => return Err("escape in string".to_owned()),
        });
    }
    Ok(out)
}

/// Decodes the text of opcode UNICODE: Latin-1 with the escapes `\uXXXX` and `\UXXXXXXXX`.
pub(super) fn unescape(line: &[u8]) -> Step<String> {
    let mut out = String::with_capacity(line.len());
    let mut rest = line;
    while let Some((&b, after)) = rest.split_first() {
        rest = after;
        if b != b'\\' {
            out.push(char::from(b));
            continue;
        }
        let digits = match rest.first() {
            Some(b'u') => 4,
            Some(b'U') => 8,
            _ => return Err("escape in text".to_owned()),
        };
        let code = rest.get(1..1 + digits).and_then(|c| u32::from_str_radix(std::str::from_utf8(c).ok()?, 16).ok());
        out.push(code.and_then(char::from_u32).ok_or("escape in text")?);
        rest = &rest[1 + digits..];
    }
    Ok(out)
}
