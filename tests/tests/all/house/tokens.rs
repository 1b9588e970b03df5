//! Rust source as names and punctuation, without comments, literals and what only tests compile.

/// A name, `::`, or one character of punctuation.
#[derive(Clone, Debug, PartialEq)]
pub enum Token {
    Name(String),
    Path,
    Sign(char),
}

/// The tokens of `text`. Lifetimes, numbers and literals are left out.
pub fn tokens(text: &str) -> Vec<Token> {
    let chars: Vec<char> = text.chars().collect();
    let (mut out, mut at) = (Vec::new(), 0);
    while let Some(&c) = chars.get(at) {
        let next = chars.get(at + 1).copied().unwrap_or('\0');
        at = match c {
            '/' if next == '/' => skip_while(&chars, at, |c| c != '\n'),
            '/' if next == '*' => skip_comment(&chars, at),
            '"' => skip_string(&chars, at),
            '\'' => skip_quote(&chars, at),
            ':' if next == ':' => {
                out.push(Token::Path);
                at + 2
            }
            _ if c.is_alphabetic() || c == '_' => {
                let end = skip_while(&chars, at, |c| c.is_alphanumeric() || c == '_');
                let name: String = chars[at..end].iter().collect();
                match (name.as_str(), chars.get(end)) {
                    ("r" | "br" | "cr", Some('"' | '#')) => skip_raw(&chars, end),
                    // The literal that follows is skipped next.
                    ("b" | "c", Some('"' | '\'')) => end,
                    _ => {
                        out.push(Token::Name(name));
                        end
                    }
                }
            }
            _ if c.is_ascii_digit() => skip_while(&chars, at, |c| c.is_alphanumeric() || c == '_'),
            _ => {
                if !c.is_whitespace() {
                    out.push(Token::Sign(c));
                }
                at + 1
            }
        };
    }
    out
}

fn skip_while(chars: &[char], at: usize, wanted: impl Fn(char) -> bool) -> usize {
    at + chars[at..].iter().take_while(|&&c| wanted(c)).count()
}

/// Past a block comment, which may contain others.
fn skip_comment(chars: &[char], mut at: usize) -> usize {
    let mut depth = 0;
    while at < chars.len() {
        match (chars[at], chars.get(at + 1)) {
            ('/', Some('*')) => (depth, at) = (depth + 1, at + 2),
            ('*', Some('/')) => (depth, at) = (depth - 1, at + 2),
            _ => at += 1,
        }
        if depth == 0 {
            break;
        }
    }
    at
}

/// Past a literal between the quotes that `at` opens.
fn skip_string(chars: &[char], at: usize) -> usize {
    let mut end = at + 1;
    while end < chars.len() && chars[end] != chars[at] {
        end += if chars[end] == '\\' { 2 } else { 1 };
    }
    end + 1
}

/// Past a character, or past the quote of a lifetime and its name.
fn skip_quote(chars: &[char], at: usize) -> usize {
    if chars.get(at + 1) == Some(&'\\') || chars.get(at + 2) == Some(&'\'') {
        return skip_string(chars, at);
    }
    skip_while(chars, at + 1, |c| c.is_alphanumeric() || c == '_')
}

/// Past the number signs, the quotes and the text of a raw string; of a raw name past the sign.
fn skip_raw(chars: &[char], at: usize) -> usize {
    let open = skip_while(chars, at, |c| c == '#');
    if chars.get(open) != Some(&'"') {
        return open;
    }
    let signs = open - at;
    let closes = |i: usize| chars[i] == '"' && chars[i + 1..].iter().take_while(|&&c| c == '#').count() >= signs;
    let end = (open + 1..chars.len()).find(|&i| closes(i));
    end.map_or(chars.len(), |end| end + 1 + signs)
}

/// `tokens` without attributes and without the items under `#[cfg(test)]`.
pub fn without_tests(tokens: &[Token]) -> Vec<Token> {
    let (mut out, mut at) = (Vec::new(), 0);
    while at < tokens.len() {
        let bracket = if tokens.get(at + 1) == Some(&Token::Sign('!')) { at + 2 } else { at + 1 };
        if tokens[at] != Token::Sign('#') || tokens.get(bracket) != Some(&Token::Sign('[')) {
            out.push(tokens[at].clone());
            at += 1;
            continue;
        }
        let end = closing(tokens, bracket);
        let name = |text: &str| tokens[bracket..end].contains(&Token::Name(text.to_owned()));
        at = end;
        if name("cfg") && name("test") && !name("not") {
            at = item_end(tokens, at);
        }
    }
    out
}

/// Past the item that starts at `at`: its body, or its semicolon.
fn item_end(tokens: &[Token], mut at: usize) -> usize {
    let is_use = tokens.get(at) == Some(&Token::Name("use".to_owned()));
    while at < tokens.len() {
        match tokens[at] {
            Token::Sign(';') => return at + 1,
            Token::Sign('{') if !is_use => return closing(tokens, at),
            Token::Sign('(' | '[' | '{') => at = closing(tokens, at),
            _ => at += 1,
        }
    }
    at
}

/// Past the bracket that closes the one at `at`.
pub fn closing(tokens: &[Token], at: usize) -> usize {
    let mut depth = 0usize;
    for (i, token) in tokens.iter().enumerate().skip(at) {
        match token {
            Token::Sign('(' | '[' | '{') => depth += 1,
            Token::Sign(')' | ']' | '}') => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth == 0 {
            return i + 1;
        }
    }
    tokens.len()
}
