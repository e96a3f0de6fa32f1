//! PLY files (Turk 1994): a header that lists elements and their properties, then the items' values, as text or binary of either byte
//! order.
//!
//! Files are not trusted: a count is held against the bytes that are there before anything is allocated by it. Lines of the header that
//! say nothing of the values are passed over, and what is wrong with an element matters to those who read it, and what follows it, alone.

use std::io::{self, Write};

use crate::srgb;

/// What is wrong with a file.
pub(crate) type Parsed<T> = Result<T, String>;

/// How a number is stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn named(name: &str) -> Parsed<Scalar> {
        Ok(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return Err(format!("unknown property type '{name:.40}'")),
        })
    }

    /// The name that all programs know.
    fn name(self) -> &'static str {
        match self {
            Scalar::I8 => "char",
            Scalar::U8 => "uchar",
            Scalar::I16 => "short",
            Scalar::U16 => "ushort",
            Scalar::I32 => "int",
            Scalar::U32 => "uint",
            Scalar::F32 => "float",
            Scalar::F64 => "double",
        }
    }

    fn bytes(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    /// The number in `bytes()` bytes, lowest first.
    fn decode(self, bits: u64) -> f64 {
        match self {
            Scalar::I8 => f64::from(bits as u8 as i8),
            Scalar::U8 => f64::from(bits as u8),
            Scalar::I16 => f64::from(bits as u16 as i16),
            Scalar::U16 => f64::from(bits as u16),
            Scalar::I32 => f64::from(bits as u32 as i32),
            Scalar::U32 => f64::from(bits as u32),
            Scalar::F32 => f64::from(f32::from_bits(bits as u32)),
            Scalar::F64 => f64::from_bits(bits),
        }
    }

    /// Bits of which the lowest `bytes()` bytes are the number, rounded or held to what the type can say.
    fn encode(self, value: f64) -> u64 {
        match self {
            Scalar::I8 => value as i8 as u64,
            Scalar::U8 => value as u8 as u64,
            Scalar::I16 => value as i16 as u64,
            Scalar::U16 => value as u16 as u64,
            Scalar::I32 => value as i32 as u64,
            Scalar::U32 => value as u32 as u64,
            Scalar::F32 => u64::from((value as f32).to_bits()),
            Scalar::F64 => value.to_bits(),
        }
    }

    /// What 1.0 is as a colour channel. Those who store it as an int mean a byte.
    fn full(self) -> f64 {
        match self {
            Scalar::I8 | Scalar::U8 | Scalar::I32 | Scalar::U32 => 255.0,
            Scalar::I16 | Scalar::U16 => 65535.0,
            Scalar::F32 | Scalar::F64 => 1.0,
        }
    }
}

/// A number of every item, or a list of numbers.
#[derive(Debug)]
pub(crate) struct Property {
    pub name: String,
    /// Type of the length, for lists.
    length: Option<Scalar>,
    scalar: Scalar,
}

impl Property {
    /// Bytes that one item's value takes at least: as text a digit and a blank.
    fn smallest(&self, is_text: bool) -> usize {
        match is_text {
            true => 2,
            false => self.length.unwrap_or(self.scalar).bytes(),
        }
    }
}

/// Items of one kind: vertices, faces, edges.
#[derive(Debug)]
pub(crate) struct Element {
    pub name: String,
    pub count: u64,
    pub properties: Vec<Property>,
    /// Why its items cannot be read, where the header does not say how they are stored.
    unknown: Option<String>,
}

impl Element {
    /// `count` items that have no properties yet.
    pub fn new(name: &str, count: usize) -> Element {
        Element {
            name: name.into(),
            count: count as u64,
            properties: Vec::new(),
            unknown: None,
        }
    }

    /// With properties of a number each.
    pub fn with(mut self, scalar: Scalar, names: &[&str]) -> Element {
        self.properties.extend(names.iter().map(|name| Property {
            name: (*name).into(),
            length: None,
            scalar,
        }));
        self
    }

    /// With a list that begins with its length.
    pub fn with_list(mut self, length: Scalar, scalar: Scalar, name: &str) -> Element {
        self.properties.push(Property {
            name: name.into(),
            length: Some(length),
            scalar,
        });
        self
    }

    /// Where three properties of these names are among an item's, if all are there and none is a list.
    pub fn columns(&self, names: [&str; 3]) -> Option<[usize; 3]> {
        let at = names.map(|name| {
            self.properties
                .iter()
                .position(|p| p.name == name && p.length.is_none())
        });
        Some([at[0]?, at[1]?, at[2]?])
    }

    /// Where x, y and z are.
    pub fn position(&self) -> Parsed<[usize; 3]> {
        self.columns(["x", "y", "z"])
            .ok_or_else(|| "has vertices without x, y, z".into())
    }

    /// Where the colour is, if there is one.
    pub fn color(&self) -> Option<[usize; 3]> {
        self.columns(["red", "green", "blue"])
            .or_else(|| self.columns(["r", "g", "b"]))
    }

    /// A colour channel as a byte: whole numbers by their type's range, others from 0 to 1.
    pub fn channel(&self, column: usize, value: f64) -> u8 {
        srgb::byte(value / self.properties[column].scalar.full())
    }
}

/// The values of one item.
#[derive(Default)]
pub(crate) struct Item {
    /// Those of all properties, one after the other, lists without their lengths.
    values: Vec<f64>,
    /// Where those of each property end.
    ends: Vec<usize>,
}

impl Item {
    /// The value of a property that is no list.
    pub fn number(&self, property: usize) -> f64 {
        self.list(property)[0]
    }

    /// The values of a property.
    pub fn list(&self, property: usize) -> &[f64] {
        let start = property
            .checked_sub(1)
            .map_or(0, |before| self.ends[before]);
        &self.values[start..self.ends[property]]
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Encoding {
    Text,
    LittleEndian,
    BigEndian,
}

/// What follows the header. Elements are read, or skipped, in their order.
pub(crate) struct Values<'a> {
    rest: &'a [u8],
    encoding: Encoding,
}

/// The elements that the header of a file lists, and their values.
pub(crate) fn read(bytes: &[u8]) -> Parsed<(Vec<Element>, Values<'_>)> {
    let mut rest = bytes;
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    loop {
        let end = rest
            .iter()
            .position(|&byte| byte == b'\n')
            .ok_or("has no PLY header that ends")?;
        let line = String::from_utf8_lossy(&rest[..end]);
        let line = line.trim();
        let is_first = rest.len() == bytes.len();
        rest = &rest[end + 1..];
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            _ if is_first && line != "ply" => return Err("does not begin with 'ply'".into()),
            ["end_header"] => break,
            ["format", name, _] => {
                encoding = Some(match name {
                    "ascii" => Encoding::Text,
                    "binary_little_endian" => Encoding::LittleEndian,
                    "binary_big_endian" => Encoding::BigEndian,
                    _ => return Err(format!("unknown format '{name:.40}'")),
                });
            }
            ["element", name, count] => {
                let mut element = Element::new(name, 0);
                match count.parse() {
                    Ok(count) => element.count = count,
                    Err(_) => element.unknown = Some(format!("'{line:.80}' has no count")),
                }
                elements.push(element);
            }
            ["property", ref kind @ .., name] => {
                let element = elements
                    .last_mut()
                    .ok_or("has a property before any element")?;
                let kind = match *kind {
                    [scalar] => Scalar::named(scalar).map(|scalar| (None, scalar)),
                    ["list", length, scalar] => Scalar::named(length)
                        .and_then(|length| Ok((Some(length), Scalar::named(scalar)?))),
                    _ => Err(format!("'{line:.80}' is no property")),
                };
                match kind {
                    Ok((length, scalar)) => element.properties.push(Property {
                        name: name.into(),
                        length,
                        scalar,
                    }),
                    Err(what) => element.unknown = Some(what),
                }
            }
            ["element" | "property" | "format", ..] => {
                return Err(format!("'{line:.80}' does not belong in a PLY header"));
            }
            _ => {}
        }
    }
    let encoding = encoding.ok_or("has no format")?;
    Ok((elements, Values { rest, encoding }))
}

impl Values<'_> {
    /// Whether what follows can hold the items of `element`, whose turn it is.
    pub fn check(&self, element: &Element) -> Parsed<()> {
        let Element { name, count, .. } = element;
        if let Some(what) = &element.unknown {
            return Err(what.clone());
        }
        let is_text = self.encoding == Encoding::Text;
        let smallest: usize = element
            .properties
            .iter()
            .map(|property| property.smallest(is_text))
            .sum();
        if smallest == 0 && *count > 0 {
            return Err(format!("the element '{name:.40}' has no properties"));
        }
        // No blank has to follow the last number of a text.
        let bytes = self.rest.len() as u64 + u64::from(is_text);
        if count.saturating_mul(smallest as u64) > bytes {
            return Err(format!(
                "promises {count} of '{name:.40}' of at least {smallest} bytes each, but only {} bytes follow",
                self.rest.len()
            ));
        }
        Ok(())
    }

    /// Reads the items of `element`, whose turn it is; `each` gets their numbers and values.
    pub fn read(
        &mut self,
        element: &Element,
        mut each: impl FnMut(u64, &Item) -> Parsed<()>,
    ) -> Parsed<()> {
        self.check(element)?;
        let Element { name, count, .. } = element;
        let ends = |index: u64| format!("ends within {name:.40} {index} of {count}");
        let mut item = Item::default();
        for index in 0..*count {
            item.values.clear();
            item.ends.clear();
            for property in &element.properties {
                let length = match property.length {
                    None => 1,
                    Some(length) => self.next(length, || ends(index))? as u64,
                };
                for _ in 0..length {
                    let value = self.next(property.scalar, || ends(index))?;
                    item.values.push(value);
                }
                item.ends.push(item.values.len());
            }
            each(index, &item)?;
        }
        Ok(())
    }

    /// Passes over the items of `element`, whose turn it is.
    pub fn skip(&mut self, element: &Element) -> Parsed<()> {
        self.read(element, |_, _| Ok(()))
    }

    fn next(&mut self, scalar: Scalar, ends: impl Fn() -> String) -> Parsed<f64> {
        if self.encoding == Encoding::Text {
            let rest = self.rest.trim_ascii_start();
            let end = rest.iter().position(u8::is_ascii_whitespace);
            let (word, rest) = rest.split_at(end.unwrap_or(rest.len()));
            self.rest = rest;
            if word.is_empty() {
                return Err(ends());
            }
            let word = String::from_utf8_lossy(word);
            return word
                .parse()
                .map_err(|_| format!("'{word:.40}' is not a number"));
        }
        let (value, rest) = self
            .rest
            .split_at_checked(scalar.bytes())
            .ok_or_else(ends)?;
        self.rest = rest;
        let mut wide = [0; 8];
        wide[..value.len()].copy_from_slice(value);
        if self.encoding == Encoding::BigEndian {
            wide[..value.len()].reverse();
        }
        Ok(scalar.decode(u64::from_le_bytes(wide)))
    }
}

/// Writes a binary file. For every item of every element in turn, `item` is given the element's name and the item's number, and adds
/// the values of its properties to an empty vector, those of a list after their number.
pub(crate) fn write(
    out: &mut impl Write,
    comment: &str,
    elements: &[Element],
    mut item: impl FnMut(&str, usize, &mut Vec<f64>),
) -> io::Result<()> {
    writeln!(
        out,
        "ply\nformat binary_little_endian 1.0\ncomment {comment}"
    )?;
    for element in elements {
        writeln!(out, "element {} {}", element.name, element.count)?;
        for Property {
            name,
            length,
            scalar,
        } in &element.properties
        {
            match length {
                None => writeln!(out, "property {} {name}", scalar.name())?,
                Some(length) => writeln!(
                    out,
                    "property list {} {} {name}",
                    length.name(),
                    scalar.name()
                )?,
            }
        }
    }
    writeln!(out, "end_header")?;
    let mut values = Vec::new();
    for element in elements {
        for index in 0..element.count as usize {
            values.clear();
            item(&element.name, index, &mut values);
            let mut rest = values.iter();
            let mut next = |scalar: Scalar| {
                let value = *rest.next().expect("a value for every property");
                let bytes = scalar.encode(value).to_le_bytes();
                out.write_all(&bytes[..scalar.bytes()]).map(|()| value)
            };
            for property in &element.properties {
                let length = match property.length {
                    None => 1.0,
                    Some(length) => next(length)?,
                };
                for _ in 0..length as u64 {
                    next(property.scalar)?;
                }
            }
            assert!(rest.next().is_none(), "a property for every value");
        }
    }
    Ok(())
}
