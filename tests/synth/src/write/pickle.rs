//! Python pickles of dictionaries, lists, texts and numpy arrays.

/// _reconstruct(ndarray, (0,), b'b'), and the beginning of its state (1, shape, dtype, False, bytes
/// or items).
const ARRAY: &[u8] = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\0\x85C\x01b\x87R(K\x01(";

/// What a pickle is made of.
#[derive(Clone, Debug)]
pub enum Py {
    /// Dictionary.
    Dict(Vec<(String, Py)>),
    /// Shape and values, `float64`, row-major.
    Array(Vec<u32>, Vec<f64>),
    /// Text.
    Text(String),
    /// List.
    List(Vec<Py>),
    /// Opcodes that leave an object.
    Raw(Vec<u8>),
}

impl Py {
    /// A text.
    #[must_use]
    pub fn text(words: &str) -> Self {
        Self::Text(words.to_owned())
    }

    /// A dictionary of named values.
    pub fn record<const N: usize>(items: [(&str, Py); N]) -> Self {
        Self::Dict(items.map(|(key, value)| (key.to_owned(), value)).into())
    }

    /// An array of `f32`.
    pub fn floats(shape: &[usize], values: &[f32]) -> Self {
        let extents = shape.iter().map(|&n| n as u32).collect();
        Self::Array(extents, values.iter().map(|&v| f64::from(v)).collect())
    }

    /// A pickle of protocol 3, which numpy since 1.8 and Python since 3.0 read.
    pub fn pickle(&self) -> Vec<u8> {
        let mut out = vec![0x80, 3];
        self.write(&mut out);
        out.push(b'.');
        out
    }

    /// The same as `numpy.save` writes it for an object: a header, then the pickle of an array of
    /// no axes with the object as its item.
    pub fn npy(&self) -> Vec<u8> {
        let dictionary = "{'descr': '|O', 'fortran_order': False, 'shape': (), }";
        // The pickle starts at a multiple of 64.
        let length = (10 + dictionary.len() + 1).next_multiple_of(64) - 10;
        let mut out = b"\x93NUMPY\x01\x00".to_vec();
        out.extend((length as u16).to_le_bytes());
        out.extend(format!("{dictionary:<width$}\n", width = length - 1).into_bytes());
        out.extend([0x80, 3]);
        out.extend(ARRAY);
        out.push(b't');
        // The state of dtype('O'): flags 63 say that items are references.
        dtype("O8", "|", b"K\x3f", &mut out);
        out.extend(b"\x89](");
        self.write(&mut out);
        out.extend(b"etb.");
        out
    }

    fn write(&self, out: &mut Vec<u8>) {
        match self {
            Self::Dict(items) => {
                out.extend(b"}(");
                for (key, value) in items {
                    text(key, out);
                    value.write(out);
                }
                out.push(b'u');
            }
            Self::Text(words) => text(words, out),
            Self::Raw(opcodes) => out.extend(opcodes),
            Self::List(items) => {
                out.extend(b"](");
                items.iter().for_each(|item| item.write(out));
                out.push(b'e');
            }
            Self::Array(shape, values) => {
                out.extend(ARRAY);
                for &n in shape {
                    out.push(b'J');
                    out.extend(n.to_le_bytes());
                }
                out.push(b't');
                dtype("f8", "<", b"K\0", out);
                out.extend(b"\x89B");
                out.extend((values.len() as u32 * 8).to_le_bytes());
                out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
                out.extend(b"tb");
            }
        }
    }
}

/// The type of an array's elements: name, byte order, flags.
fn dtype(name: &str, order: &str, flags: &[u8], out: &mut Vec<u8>) {
    out.extend(b"cnumpy\ndtype\n");
    text(name, out);
    out.extend(b"K\0K\x01\x87R(K\x03");
    text(order, out);
    out.extend(b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xff");
    out.extend(flags);
    out.extend(b"tb");
}

fn text(words: &str, out: &mut Vec<u8>) {
    out.push(b'X');
    out.extend((words.len() as u32).to_le_bytes());
    out.extend(words.as_bytes());
}

impl Py {
    /// Removes the entry at a path of keys.
    ///
    /// # Panics
    /// For what is not a dictionary.
    pub fn remove(&mut self, keys: &[&str]) {
        let Self::Dict(items) = self else { panic!("not a dictionary") };
        if let [last] = keys {
            items.retain(|(key, _)| key != last);
        } else if let Some((_, slot)) = items.iter_mut().find(|(key, _)| key == keys[0]) {
            slot.remove(&keys[1..]);
        }
    }

    /// The item at a path of keys; a number is a place in a list.
    ///
    /// # Panics
    /// Where there is none.
    pub fn at(&mut self, keys: &[&str]) -> &mut Py {
        let Some((first, rest)) = keys.split_first() else { return self };
        let found = match self {
            Self::Dict(items) => items.iter_mut().find(|(key, _)| key == first).map(|(_, value)| value),
            Self::List(items) => first.parse().ok().and_then(|i: usize| items.get_mut(i)),
            _ => None,
        };
        found.expect("no such item").at(rest)
    }
}
