//! Bytes of a pickle, taken one field after another.

use std::borrow::Cow;

/// Result of an operation of the machine; the message is completed with file and offset at the
/// outside.
pub(super) type Step<T> = Result<T, String>;

/// A cursor over the input.
pub(super) struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    pub(super) fn new(bytes: &'a [u8], at: usize) -> Self {
        Self { bytes, at }
    }

    pub(super) fn offset(&self) -> usize {
        self.at
    }

    pub(super) fn take(&mut self, length: u64) -> Step<&'a [u8]> {
        let rest = &self.bytes[self.at..];
        let length = usize::try_from(length).ok().filter(|&n| n <= rest.len());
        let length = length.ok_or("truncated")?;
        self.at += length;
        Ok(&rest[..length])
    }

    pub(super) fn u8(&mut self) -> Step<u8> {
        Ok(self.take(1)?[0])
    }

    /// Little-endian unsigned integer of `size` ≤ 8 bytes.
    pub(super) fn uint(&mut self, size: u64) -> Step<u64> {
        let mut word = [0u8; 8];
        let bytes = self.take(size)?;
        word[..bytes.len()].copy_from_slice(bytes);
        Ok(u64::from_le_bytes(word))
    }

    /// Bytes preceded by their length in `size` bytes.
    pub(super) fn counted(&mut self, size: u64) -> Step<&'a [u8]> {
        let length = self.uint(size)?;
        self.take(length)
    }

    /// Text preceded by its length in `size` bytes.
    pub(super) fn counted_text(&mut self, size: u64) -> Step<Cow<'a, str>> {
        let bytes = self.counted(size)?;
        let text = std::str::from_utf8(bytes).map_err(|_| "text is not UTF-8")?;
        Ok(Cow::Borrowed(text))
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
        std::str::from_utf8(self.line_bytes()?)
            .map(|line| line.trim_end_matches('\r'))
            .map_err(|_| "line is not UTF-8".to_owned())
    }
}

/// Two's complement of any length, little-endian, as opcode LONG1 stores it.
pub(super) fn long(bytes: &[u8]) -> Step<i64> {
    let negative = bytes.last().is_some_and(|b| b & 0x80 != 0);
    let fill = if negative { 0xff } else { 0 };
    let mut word = [fill; 8];
    for (i, &b) in bytes.iter().enumerate() {
        match word.get_mut(i) {
            Some(slot) => *slot = b,
            None if b == fill => {}
            None => return Err("integer beyond 64 bits".to_owned()),
        }
    }
    let value = i64::from_le_bytes(word);
    if (value < 0) != negative {
        return Err("integer beyond 64 bits".to_owned());
    }
    Ok(value)
}

/// Undoes the escapes of a quoted Python 2 string literal.
pub(super) fn unquote(line: &str) -> Step<Vec<u8>> {
    let inner = (line.strip_prefix('\'').and_then(|s| s.strip_suffix('\'')))
        .or_else(|| line.strip_prefix('"').and_then(|s| s.strip_suffix('"')))
        .ok_or("string without quotes")?;
    let mut out = Vec::with_capacity(inner.len());
    let mut bytes = inner.bytes();
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
                let digit = |b: Option<u8>| b.and_then(|b| char::from(b).to_digit(16));
                let (high, low) = (digit(bytes.next()), digit(bytes.next()));
                match (high, low) {
                    (Some(high), Some(low)) => (16 * high + low) as u8,
                    _ => return Err("escape in string".to_owned()),
                }
            }
            Some(b @ (b'\\' | b'\'' | b'"')) => b,
            _ => return Err("escape in string".to_owned()),
        });
    }
    Ok(out)
}

/// Text of opcode UNICODE: Latin-1 with the escapes `\uXXXX` and `\UXXXXXXXX`.
pub(super) fn unescape(line: &[u8]) -> Step<String> {
    let mut out = String::with_capacity(line.len());
    let mut at = 0;
    while let Some(&b) = line.get(at) {
        at += 1;
        if b != b'\\' {
            out.push(char::from(b));
            continue;
        }
        let digits = match line.get(at) {
            Some(b'u') => 4,
            Some(b'U') => 8,
            _ => return Err("escape in text".to_owned()),
        };
        let code = line.get(at + 1..at + 1 + digits);
        let code = code.and_then(|c| std::str::from_utf8(c).ok());
        let code = code.and_then(|c| u32::from_str_radix(c, 16).ok());
        out.push(code.and_then(char::from_u32).ok_or("escape in text")?);
        at += 1 + digits;
    }
    Ok(out)
}
