//! Rust source as names and punctuation, without comments, literals and what only tests compile.

use proc_macro2::{Delimiter, Spacing, TokenStream, TokenTree};

/// A name, `::`, or one character of punctuation.
#[derive(Clone, Debug, PartialEq)]
pub enum Token {
    Name(String),
    Path,
    Sign(char),
}

/// The tokens of `text`. Lifetimes, literals, attributes and items under `#[cfg(test)]` are left
/// out.
pub fn tokens(text: &str) -> Vec<Token> {
    let mut out = Vec::new();
    flatten(text.parse().expect("a file of Rust"), &mut out);
    out
}

fn flatten(stream: TokenStream, out: &mut Vec<Token>) {
    let mut trees = stream.into_iter().peekable();
    while let Some(tree) = trees.next() {
        match tree {
            TokenTree::Ident(name) => out.push(Token::Name(name.to_string())),
            TokenTree::Literal(_) => {}
            TokenTree::Group(group) => {
                let (open, close) = match group.delimiter() {
                    Delimiter::Parenthesis => ('(', ')'),
                    Delimiter::Brace => ('{', '}'),
                    Delimiter::Bracket | Delimiter::None => ('[', ']'),
                };
                out.push(Token::Sign(open));
                flatten(group.stream(), out);
                out.push(Token::Sign(close));
            }
            TokenTree::Punct(sign) => match (sign.as_char(), trees.peek()) {
                ('\'', _) => drop(trees.next()),
                (':', Some(TokenTree::Punct(next))) if next.as_char() == ':' && sign.spacing() == Spacing::Joint => {
                    trees.next();
                    out.push(Token::Path);
                }
                ('#', _) => {
                    let attribute = trees.find_map(|tree| match tree {
                        TokenTree::Group(group) => Some(group.stream().to_string()),
                        _ => None,
                    });
                    let attribute = attribute.unwrap_or_default();
                    let has = |word| attribute.split(|c: char| !c.is_alphanumeric()).any(|part| part == word);
                    if attribute.starts_with("cfg") && has("test") && !has("not") {
                        skip_item(&mut trees);
                    }
                }
                (sign, _) => out.push(Token::Sign(sign)),
            },
        }
    }
}

/// Past an item: its body, or its semicolon.
fn skip_item(trees: &mut std::iter::Peekable<impl Iterator<Item = TokenTree>>) {
    let is_use = matches!(trees.peek(), Some(TokenTree::Ident(name)) if *name == "use");
    for tree in trees {
        match tree {
            TokenTree::Punct(sign) if sign.as_char() == ';' => return,
            TokenTree::Group(group) if group.delimiter() == Delimiter::Brace && !is_use => return,
            _ => {}
        }
    }
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
